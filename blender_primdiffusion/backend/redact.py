"""Remove folders and the names of the user and the machine from the text of a bug report."""

from __future__ import annotations

import re
from collections.abc import Iterable

_KNOWN = re.compile(
    r"(?:blender_primdiffusion|primdiffusion|site-packages|dist-packages|python3\.\d+|scripts[/\\]+(?:modules|addons_core))"
    r"[/\\].*",
    re.DOTALL,
)
"""From these folders on, a path belongs to a program and is not private."""
_SLASH = r"(?:/|\\{1,8}|%2[Ff]|%5[Cc])"
_DRIVE = rf"(?:file:/{{2,3}})?[A-Za-z](?::|%3[Aa]){_SLASH}"
_SHARE = r"(?:file:/*)?(?:\\{2,8}|(?:%5[Cc]){2,8})(?=[^\s\\])"
_ROOT = r"(?:file:)?(?:/|%2[Ff])+(?=[^\s/])"
_START = rf"(?:{_DRIVE}|{_SHARE}|{_ROOT})"
"""C:\\, UNC, /, file://; as they are, in JSON and percent-encoded."""
_PART = r"[^\s\"'<>|*?:,;()\[\]{}/\\%]|%(?!2[Ff]|5[Cc])"
_WORD = rf"(?:{_PART})+"
_FOLDER = rf"{_WORD}(?: {_WORD})*{_SLASH}"
_FILE = rf"(?:{_WORD}(?: {_WORD}){{0,5}}?\.[A-Za-z][A-Za-z0-9]{{0,12}}(?![A-Za-z0-9.])|{_WORD})?"
_PATH = re.compile(rf"(?<![A-Za-z0-9_.<>~/\\%]){_START}(?:{_FOLDER})*{_FILE}")
_QUOTED = re.compile(rf"(?P<quote>[\"'])(?P<path>{_START}[^\"'\n]*)(?P=quote)")
_SUFFIX = re.compile(r"\.[A-Za-z][A-Za-z0-9]{0,12}$")


def redact(text: str, names: Iterable[str] = ()) -> str:
    """`text` with absolute paths as <path>, and each of `names` (of the user, of the machine) as <name>.

    A file's ending stays, and so does what lies below a program's folder: <path>/site-packages/torch/nn.py. Paths are
    found also with blanks, in JSON, percent-encoded, on Windows and on shares. Too much may go, too little must not.
    """
    text = _QUOTED.sub(lambda found: f"{found['quote']}{_short(found['path'])}{found['quote']}", text)
    text = _PATH.sub(lambda found: _short(found[0]), text)
    for name in sorted({name for name in names if len(name) > 1}, key=len, reverse=True):
        text = re.sub(rf"(?<![A-Za-z0-9]){re.escape(name)}(?![A-Za-z0-9])", "<name>", text, flags=re.IGNORECASE)
    return text


def _short(path: str) -> str:
    if not re.search(r"[^/\\%]", path):
        return path
    if known := _KNOWN.search(path):
        return f"<path>/{known[0]}"
    ending = _SUFFIX.search(path)
    return f"<path>{ending[0] if ending else ''}"
