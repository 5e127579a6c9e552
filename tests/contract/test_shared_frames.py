"""Frames that both programs map, also where a mapped file cannot be removed (test_windows_rules.py)."""

import pytest
from primdiffusion.commands.frame_drawer import map_frame

from blender_primdiffusion.engine.studio import SharedFrames


@pytest.fixture
def frames():
    frames = SharedFrames()
    yield frames
    frames.close()


def test_the_file_of_a_dropped_frame_goes_at_the_latest_when_another_is_dropped_after_its_last_user(frames):
    old = frames.take("view", 8, 4)
    old.clear()
    path, shown = old.path, old.combined
    new = frames.take("view", 4, 4)
    assert new.path != path
    assert not shown.any()  # still mapped
    del old, shown
    frames.drop("view")
    assert not path.exists()


def test_what_the_child_writes_is_what_blender_sees_and_the_folder_goes_with_its_users(frames):
    frame = frames.take("view", 8, 4)
    picture = map_frame(frame.path, 8, 4)
    picture.combined[:] = 0.5
    assert (frame.combined == 0.5).all()
    folder = frame.path.parent
    del frame, picture
    frames.close()
    assert not folder.exists()
