"""The backend's `primdiffusion.formats`, without the backend: the same files, found in its folder.

That folder is `bundled/` in the zip, and `backend/` beside the extension in a checkout. Only this package's search path
names it, so that nothing else of the backend can be imported.
"""

from pathlib import Path

_EXTENSION = Path(__file__).resolve().parents[1]
_FOLDERS = (_EXTENSION / "bundled", _EXTENSION.parent / "backend")
__path__ = [str(folder / "primdiffusion" / "formats") for folder in _FOLDERS]
