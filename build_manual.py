"""Convert the manual (docs/manual/*.md) to HTML pages that work without a network.

`build_addon.py` adds them to the zip. The panels' question marks open them.
"""

from __future__ import annotations

import html
import re
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from markdown_it.token import Token

MANUAL = Path(__file__).resolve().parent / "docs" / "manual"
_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>{title} - PrimDiffusion</title><style>
body {{ max-width: 52rem; margin: 2rem auto; padding: 0 1rem; font: 16px/1.55 sans-serif; color: #222 }}
pre, code {{ background: #f2f2f2; font-size: .92em }} pre {{ padding: .7rem; overflow-x: auto }}
table {{ border-collapse: collapse }}
th, td {{ border: 1px solid #ccc; padding: .25rem .6rem; text-align: left; vertical-align: top }}
img {{ max-width: 100% }} a {{ color: #0b57a4 }}
@media (prefers-color-scheme: dark) {{ body {{ color: #ddd; background: #1d1d1d }} pre, code {{ background: #2b2b2b }}
th, td {{ border-color: #444 }} a {{ color: #7fb8ee }} }}
</style></head><body>
{body}
</body></html>
"""


class ManualError(RuntimeError):
    """The manual cannot be converted; the message says why."""


def manual(folder: Path = MANUAL) -> dict[str, bytes]:
    """Contents of the manual's files by name: an HTML page for each .md, and the pictures on the pages.

    Links between pages point to the HTML pages. Links out of the folder are replaced with their text. Raises
    ManualError for a broken link or a missing picture.
    """
    files: dict[str, bytes] = {}
    for path in sorted(folder.glob("*.md")):
        tokens = _parse(path)
        _follow_links(tokens, path, files)
        title = next((t.content for t in tokens if t.type == "inline"), path.stem)
        markdown = _markdown()
        body = markdown.renderer.render(tokens, markdown.options, {})
        files[f"{path.stem}.html"] = _PAGE.format(title=html.escape(title), body=body).encode()
    return files


def slug(heading: str) -> str:
    """The anchor of a heading, as on GitHub."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def _markdown():
    try:
        from markdown_it import MarkdownIt
    except ImportError as error:
        raise ManualError("markdown-it-py is needed to build the manual: pip install markdown-it-py") from error
    return MarkdownIt("commonmark", {"html": False}).enable(["table", "strikethrough"])


def _parse(path: Path) -> list[Token]:
    tokens = _markdown().parse(path.read_text(encoding="utf-8"))
    for opened, inline in pairwise(tokens):
        if opened.type == "heading_open":
            opened.attrSet("id", slug("".join(t.content for t in inline.children or () if t.type != "image")))
    return tokens


def _follow_links(tokens: list[Token], path: Path, files: dict[str, bytes]) -> None:
    """Point links to the HTML pages, and add the pictures to `files`."""
    unlinked = False
    for token in (child for block in tokens for child in block.children or ()):
        if token.type == "image":
            token.attrSet("src", _add_picture(str(token.attrGet("src")), path, files))
        elif token.type == "link_open":
            href = _html_link(str(token.attrGet("href")), path)
            token.attrSet("href", href)
            if unlinked := not href:
                _blank(token)
        elif token.type == "link_close" and unlinked:
            _blank(token)


def _blank(token: Token) -> None:
    token.type, token.tag, token.content = "text", "", ""


def _html_link(href: str, path: Path) -> str:
    """The link's target among the HTML pages; empty if it points to another folder."""
    target, _, anchor = href.partition("#")
    if re.match(r"[a-z]+:", target) or not target:
        return href
    if not (path.parent / target).exists():
        raise ManualError(f"{path.name} links to {target}, which does not exist")
    if "/" in target or not target.endswith(".md"):
        return ""
    return target.removesuffix(".md") + ".html" + (f"#{anchor}" if anchor else "")


def _add_picture(name: str, path: Path, files: dict[str, bytes]) -> str:
    """Add a picture to `files` and return its name there.

    A picture in the manual's folder keeps its path, any other goes to pictures/.
    """
    source, folder = (path.parent / name).resolve(), path.parent.resolve()
    if not source.is_file():
        raise ManualError(f"{path.name} shows {name}, which does not exist")
    target = source.relative_to(folder).as_posix() if source.is_relative_to(folder) else f"pictures/{source.name}"
    files[target] = source.read_bytes()
    return target
