"""The backend's `primdiffusion.files`, found as `formats` is."""

from pathlib import Path

from ..formats import __path__ as _formats

__path__ = [str(Path(folder).with_name("files")) for folder in _formats]
