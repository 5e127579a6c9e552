"""The backend's `primdiffusion.formats`, without the backend: the same files, found in its folder.

That folder lies in the zip and beside the extension in a checkout. Only this package's search path names it, so that
nothing else of the backend can be imported.
"""

from pathlib import Path

_EXTENSION = Path(__file__).resolve().parents[1]
__path__ = [str(root / "backend" / "primdiffusion" / "formats") for root in (_EXTENSION, _EXTENSION.parent)]
