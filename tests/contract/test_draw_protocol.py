"""draw, as the protocol promises it to anyone: a frame in a file, filled from the top, stopped when asked."""

import itertools
from pathlib import Path

import numpy as np
import pytest
import torch
from conversation import Conversation
from primdiffusion.commands.render import map_frame
from primdiffusion.human import Human, framing, generate, place, pose_body
from primdiffusion.human_file import save_human
from support.tiny import tiny_model

from blender_primdiffusion.engine.drawing_child import SharedFrames

CANCELLED, DOMAIN_ERROR = -32001, -32002
STILL = torch.eye(3, 4).tolist()
ids = itertools.count(1)


@pytest.fixture(scope="module")
def person(tmp_path_factory) -> tuple[str, Human]:
    human = generate(tiny_model(), seed=3, steps=2)
    path = tmp_path_factory.mktemp("person") / "a ü.human.safetensors"
    save_human(path, human)
    return str(path), human


@pytest.fixture
def request_for(person, tmp_path):
    path, human = person
    primitives = place(human)
    joints = pose_body(human.betas).skinning[:, :3].tolist()

    def params(width: int = 48, height: int = 64, **changes) -> dict:
        camera = framing(primitives, 0.0, width, height)
        frame = tmp_path / f"{width}x{height}.frame"
        np.full(width * height * 5, np.nan, np.float32).tofile(frame)
        return {
            "frame": str(frame),
            "width": width,
            "height": height,
            "region": None,
            "intrinsics": camera.intrinsics.tolist(),
            "world_to_camera": camera.world_to_camera.tolist(),
            "clip": [0.1, 100.0],
            "people": [{"human": path, "object": STILL, "joints": joints, "betas": None}],
            "solids": None,
            "background": None,
            "view": "colour",
            "step": 0.004,
            **changes,
        }

    return params


def frame_of(params: dict) -> tuple[np.ndarray, np.ndarray]:
    """Combined and depth, top row first."""
    width, height = params["width"], params["height"]
    values = np.fromfile(params["frame"], np.float32)
    combined = values[: width * height * 4].reshape(height, width, 4)
    return combined[::-1], values[width * height * 4 :].reshape(height, width)[::-1]


def ask(child: Conversation, params: dict) -> tuple[dict, list[dict]]:
    """The answer, and the progress before it."""
    id, progress = next(ids), []
    child.send(id, "draw", **params)

    def answered(message) -> bool:
        if message.get("method") == "progress":
            assert message["params"]["id"] == id
            progress.append(message["params"])
        return "method" not in message and message["id"] == id

    return child.until(answered), progress


def test_the_child_fills_the_frame(child, request_for):
    params = request_for()
    answer, progress = ask(child, params)
    assert 0 < answer["result"]["seconds_place"] <= answer["result"]["seconds"]
    assert 0 <= answer["result"]["seconds_march"] <= answer["result"]["seconds"]
    combined, depth = frame_of(params)
    assert np.isfinite(combined).all()
    assert 0.03 < (combined[..., 3] > 0).mean() < 0.7
    assert (depth[combined[..., 3] == 0] == np.float32(1e10)).all()
    assert 0.02 < (depth < 100).mean() < 0.6
    assert [p["step"] for p in progress] == sorted({p["step"] for p in progress})
    assert (progress[0]["step"], progress[-1]["step"]) == (0, 64)
    assert {(p["stage"], p["total"]) for p in progress} == {("draw", 64)}
    assert progress[-1]["eta_s"] == 0


def test_a_large_picture_comes_in_bands_from_the_top_and_stops_within_one(child, request_for):
    params = request_for(width=900, height=1200, step=0.0005)
    id = next(ids)
    child.send(id, "draw", **params)
    first = child.until(lambda m: m.get("method") == "progress" and m["params"]["step"] > 0)["params"]
    assert first["step"] < 600
    combined, _ = frame_of(params)
    assert np.isfinite(combined[: first["step"]]).all()
    assert np.isnan(combined[-1]).all(), "the bottom comes last"
    assert child.ask(next(ids), "cancel", id=id)["result"] == {"cancelled": True}
    later = []
    end = child.until(lambda m: later.append(m) or m.get("id") == id)
    assert end["error"]["code"] == CANCELLED
    assert sum(m.get("method") == "progress" for m in later) <= 1
    assert np.isnan(frame_of(params)[0][-1]).all()
    answer, _ = ask(child, request_for())
    assert "result" in answer, "the next picture is drawn"


def test_wrong_files_are_one_sentence_and_the_conversation_goes_on(child, request_for, tmp_path):
    params = request_for()
    missing = {**params["people"][0], "human": str(tmp_path / "nobody.human.safetensors")}
    flat = {**params["people"][0], "object": [[0.0] * 4] * 3}
    Path(tmp_path / "text.npz").write_text("no arrays")
    for changes, kind, message in (
        ({"frame": str(tmp_path / "none.frame")}, "missing_file", "none.frame"),
        ({"width": 49}, "bad_input", "49 x 64 pixels need 62720"),
        ({"people": [missing]}, "missing_file", "nobody.human"),
        ({"people": [flat]}, "bad_input", "scale"),
        ({"solids": str(tmp_path / "text.npz")}, "bad_input", "text.npz is damaged"),
    ):
        answer, _ = ask(child, {**params, **changes})
        assert (answer["error"]["code"], answer["error"]["data"]["kind"]) == (DOMAIN_ERROR, kind)
        assert message in answer["error"]["message"]
        assert "\n" not in answer["error"]["message"]
    assert "result" in ask(child, params)[0]


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
