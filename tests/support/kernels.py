"""One cache of compiled kernels for all tests, their child processes and installed copies of the backend.

numba has a cache for each folder of sources, and compiling the marcher takes half a minute.
"""

import contextlib
import hashlib
import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
BACKEND = ROOT / "backend" / "primdiffusion"
CACHE = ROOT / ".pytest_cache" / "children"
INSTALLED = "extensions/user_default/primdiffusion/bundled/primdiffusion"
"""The backend's path in Blender's user folder."""


def share() -> None:
    """Name the cache in the environment; call before numba is imported."""
    os.environ.setdefault("PRIMDIFFUSION_CACHE", str(CACHE))
    os.environ.setdefault("NUMBA_CACHE_DIR", str(CACHE / "numba"))  # where the extension tells children to cache
    for folder in {path.parents[1] for path in BACKEND.rglob("__pycache__/*.nbi")}:  # compiled when this was set up
        own = _cache_of(folder)
        own.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(OSError):  # it is there, or this system has no links
            own.symlink_to(folder / "__pycache__")


def share_with_installed(user_folder: Path) -> None:
    """Let a zip that is installed into this user folder of Blender find the kernels of the checkout."""
    for folder in {path.parent for path in BACKEND.rglob("*.py")}:
        own = _cache_of(folder)
        own.mkdir(parents=True, exist_ok=True)
        installed = _cache_of(user_folder.resolve() / INSTALLED / folder.relative_to(BACKEND))
        if not installed.exists():  # pytest counts its folders anew where /tmp was emptied; the cache may be older
            installed.symlink_to(own)


def _cache_of(sources: Path) -> Path:
    """As numba's `UserProvidedCacheLocator` names it."""
    return CACHE / "numba" / f"{sources.name}_{hashlib.sha1(str(sources).encode()).hexdigest()}"
