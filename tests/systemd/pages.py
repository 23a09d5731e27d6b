"""What the pages that are installed link to."""

import re
from pathlib import Path

DOCUMENTS = Path("usr/share/doc/lumiloop")
LINK = re.compile(r"""\]\(([^)\s]+)\)|(?:src|href)=["']([^"']+)""")


def dead_links(tree: Path) -> list[str]:
    """Of all pages below ``tree``, an installation's DESTDIR: links that lead nowhere, or out of it."""
    folder = tree / DOCUMENTS
    dead = [f"{path.relative_to(folder)} -> {path.readlink()}" for path in folder.rglob("*") if not path.exists()]
    for page in sorted(folder.rglob("*.md")):
        for pair in LINK.findall(page.read_text()):
            target = next(filter(None, pair))
            if re.match(r"\w+:", target) or target.startswith("#"):
                continue
            place = (page.parent / target.partition("#")[0]).resolve()
            if not place.exists() or not place.is_relative_to(tree.resolve()):
                dead.append(f"{page.relative_to(folder)}: {target}")
    return dead
