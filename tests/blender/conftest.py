"""Blender as a module: one process, a user folder of its own, an empty scene for each test."""

import contextlib
import os
import shutil
import tempfile
import time
from pathlib import Path

import pytest
from support import kernels

_PREFIX, _DAY_S = "primdiffusion_blender_", 24 * 3600
_OWN = Path(tempfile.mkdtemp(prefix=_PREFIX))
"""Of this process: Blender's user folder, and the temporary files of Blender and of all programs that tests start."""
for _name in ("user", "tmp"):
    (_OWN / _name).mkdir()
os.environ.setdefault("BLENDER_USER_RESOURCES", str(_OWN / "user"))
os.environ["TMPDIR"] = str(_OWN / "tmp")
kernels.share()

bpy = pytest.importorskip("bpy", reason="bpy is not installed: pip install -e .[blender]")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker("blender")


def pytest_unconfigure() -> None:
    shutil.rmtree(_OWN, ignore_errors=True)
    for crashed in _OWN.parent.glob(f"{_PREFIX}*"):
        with contextlib.suppress(FileNotFoundError):  # another process removes it too
            if time.time() - crashed.stat().st_mtime > _DAY_S:
                shutil.rmtree(crashed, ignore_errors=True)


GRIDS_KEPT_MB = 64
"""Blender keeps grids of files that are long deleted, up to 4 GB of them in each worker."""


@pytest.fixture(scope="module")
def factory_settings():
    """The preferences and add-ons of a new Blender: reading them takes five times as long as an empty file."""
    bpy.ops.wm.read_factory_settings(use_empty=True)


@pytest.fixture
def empty_scene(factory_settings):
    """A context with an empty, unsaved file."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    # Blender remembers what it read of volumes, and which were missing: only in another folder are they new to it
    bpy.context.preferences.filepaths.temporary_directory = ""
    bpy.context.preferences.system.memory_cache_limit = GRIDS_KEPT_MB
    return bpy.context


@pytest.fixture
def saved_scene(empty_scene, tmp_path):
    """A context with an empty file saved as shot.blend."""
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "shot.blend"))
    return empty_scene


@pytest.fixture
def splats():
    """New humans are shown by splats, if this Blender has them."""


@pytest.fixture(autouse=True)
def only_volumes(request, monkeypatch):
    """New humans are shown by volumes on every Blender, unless a test asks for `splats`."""
    if "splats" not in request.fixturenames:
        from blender_primdiffusion.jobs import parts
        from blender_primdiffusion.scene import build, representation

        for module in (build, parts, representation):
            monkeypatch.setattr(module, "SPLATS_AVAILABLE", False)


@pytest.fixture
def addon(saved_scene, tmp_path, monkeypatch):
    """The add-on registered from the checkout, on an interpreter that runs the fake child."""
    import synthetic
    from backend_python import use_this_python
    from support.fake_child import FAKE_CHILD

    import blender_primdiffusion
    from blender_primdiffusion.jobs.queue import queue

    monkeypatch.setenv("FAKE_HUMAN", str(synthetic.write(tmp_path / "prepared", 8)))
    use_this_python(monkeypatch, FAKE_CHILD)
    queue.outcomes.clear()
    queue.info = {}
    blender_primdiffusion.register()
    yield saved_scene
    blender_primdiffusion.unregister()


@pytest.fixture
def real_child(saved_scene, tmp_path, monkeypatch):
    """The add-on registered from the checkout, with the real child and the checkpoint of a small model."""
    from backend_python import use_this_python
    from support.tiny import save_tiny_checkpoint

    import blender_primdiffusion
    from blender_primdiffusion.backend.client import BackendClient
    from blender_primdiffusion.jobs import queue

    checkpoint = save_tiny_checkpoint(tmp_path / "tiny.safetensors")
    use_this_python(monkeypatch)
    monkeypatch.setattr(queue, "preference", lambda name: str(checkpoint) if name == "checkpoint" else "")
    # With a cache in Blender's temporary folder the child would compile its marcher anew for each test.
    monkeypatch.setattr(
        "blender_primdiffusion.backend.client.BackendClient",
        lambda python, module, cache_dir: BackendClient(python, module),
    )
    blender_primdiffusion.register()
    yield saved_scene
    blender_primdiffusion.unregister()
