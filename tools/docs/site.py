"""Hooks of mkdocs (`mkdocs.yml`): anchors as on GitHub; links that leave the folder of pages become plain text."""

import posixpath
import re
from typing import Any, Final

LINK: Final = re.compile(r"(?<!!)\[([^\]]*)\]\(([^)\s]+)\)")


def on_config(config: Any) -> Any:
    """Give headings the anchors that GitHub gives them, so that one link serves both."""
    from pymdownx.slugs import slugify  # type: ignore[import-not-found, unused-ignore]  # comes with mkdocs-material

    config.mdx_configs["toc"]["slugify"] = slugify(case="lower")
    return config


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Markdown of a page for the site."""
    return within(markdown, page.file.src_uri)


def within(markdown: str, page: str) -> str:
    """Markdown without links to files outside of the folder of pages, of which the site has none.

    Args:
        markdown: text of the page.
        page: its path in that folder, with forward slashes.
    """

    def kept(link: re.Match[str]) -> str:
        label, target = link.groups()
        outside = posixpath.normpath(posixpath.join(posixpath.dirname(page), target)).startswith("..")
        return label if outside and ":" not in target else link[0]

    return LINK.sub(kept, markdown)
