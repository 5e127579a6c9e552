"""A human whose volumes are written later, and as many of them written as a test asks for."""

from __future__ import annotations

import bpy
import pytest
import synthetic_shape
from deferred_volumes_stage import COUNT, STATES, advance, generated

from blender_primdiffusion.jobs import edit
from blender_primdiffusion.scene import attachment, build


@pytest.fixture
def hidden(addon, tmp_path, monkeypatch):
    """Volumes are written as with a window."""
    for module in (build, edit):
        monkeypatch.setattr(module, "volumes_may_wait", lambda person: not attachment.in_viewport(person))
    monkeypatch.setenv("FAKE_HUMAN", str(synthetic_shape.write(tmp_path / "prepared", COUNT)))
    return addon


@pytest.fixture
def person(hidden):
    """A human who stands, without a volume on disk."""
    bpy.ops.ed.undo_push(message="before")
    return generated()


@pytest.fixture(params=STATES)
def in_each_state(person, request):
    advance(request.param)
    return person
