"""Frames that both programs map."""

import pytest
from primdiffusion.commands.render import map_frame

from blender_primdiffusion.engine.drawing_child import SharedFrames


@pytest.fixture
def frames():
    frames = SharedFrames()
    yield frames
    frames.close()


def test_a_frame_of_another_size_replaces_the_file_at_the_latest_with_the_folder(frames):
    old = frames.take(8, 4)
    old.combined[:] = 0
    path, shown, folder = old.path, old.combined, frames.folder
    assert frames.take(4, 4).path != path
    assert not shown.any()  # still mapped
    del old, shown
    frames.close()
    assert not folder.exists()


def test_the_file_of_a_frame_that_nobody_maps_goes_when_another_is_taken(frames):
    path = frames.take(8, 4).path
    frames.take(4, 4)
    assert not path.exists()


def test_what_the_child_writes_is_what_blender_sees_and_the_folder_goes_with_its_users(frames):
    frame = frames.take(8, 4)
    picture = map_frame(frame.path, 8, 4)
    picture.rgb[:] = picture.alpha[:] = 0.5
    assert (frame.combined == 0.5).all()
    folder = frame.path.parent
    del frame, picture
    frames.close()
    assert not folder.exists()
