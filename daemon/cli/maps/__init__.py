"""Bodies of the ``lumiloop map`` verbs: export, render, import, align, name, info and verify."""
