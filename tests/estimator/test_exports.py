"""What the estimator exports: the same names for the interpreter and the type checker, and all that other rooms use."""

import ast
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ["estimator", "estimator.calibration"]


def checked_names(package: str) -> set[str]:
    """Names that the type checker sees: those imported under TYPE_CHECKING."""
    tree = ast.parse((ROOT / package.replace(".", "/") / "__init__.py").read_text())
    blocks = [node for node in tree.body if isinstance(node, ast.If)]
    return {alias.name for node in ast.walk(blocks[0]) if isinstance(node, ast.ImportFrom) for alias in node.names}


def used_names() -> dict[str, set[str]]:
    """Names that the daemon and the taps import of each package of the estimator."""
    used: dict[str, set[str]] = {}
    for path in [*ROOT.glob("daemon/**/*.py"), *ROOT.glob("taps/**/*.py")]:
        for node in ast.walk(ast.parse(path.read_text(), str(path))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "estimator":
                used.setdefault(node.module or "", set()).update(alias.name for alias in node.names)
            elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "estimator":
                used.setdefault("estimator", set()).add(node.attr)
    return used


@pytest.mark.parametrize("package", PACKAGES)
def test_the_interpreter_and_the_type_checker_see_the_same_names(package: str) -> None:
    module = import_module(package)
    assert set(module.__all__) == set(dir(module)) == checked_names(package)
    for name in module.__all__:
        assert getattr(module, name) is not None
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        module.__getattr__("nothing")


@pytest.mark.parametrize("package", PACKAGES)
def test_exactly_what_other_rooms_use_is_exported(package: str) -> None:
    assert set(import_module(package).__all__) == used_names()[package]


def test_other_rooms_import_packages_that_export_and_none_of_their_modules() -> None:
    assert set(used_names()) <= {*PACKAGES, "estimator.paper"}


def test_an_import_of_the_package_loads_no_module_of_it() -> None:
    code = (
        "import sys, estimator; print(sorted(name for name in sys.modules if 'estimator' in name or name == 'numpy'))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "['estimator', 'estimator.lazy_exports']\n"
