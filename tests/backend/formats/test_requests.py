"""What a request means and which values contradict each other; limits of single fields are declared (`test_schema`)."""

import dataclasses
import json
import math
from pathlib import Path

import pytest
from primdiffusion.formats.requests import REQUESTS, DrawRequest, PosedPerson
from primdiffusion.formats.schema import FieldError, field_types, read, written

STILL = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]
CAMERA = [[50.0, 0, 32], [0, 50.0, 24], [0, 0, 1]]
GIVEN = {
    "seed": 1, "seeds": [1], "id": 1, "region": ["top"], "voxel": 0.01, "width": 64, "height": 48, "out": "a.png",
    **dict.fromkeys(("person", "other", "source", "out_dir", "human", "frame"), "a"),
    "world_to_camera": STILL, "intrinsics": CAMERA, "people": [{"human": "h", "object": STILL, "joints": [STILL] * 24}],
}  # fmt: skip
OTHERWISE = {
    "gaussians": {"out": "a.ply"},
    "merge": {"out": "a.npz", "humans": ["a"]},
    "reconstruct": {"capture": "a"},
    "fit_posture": {"pictures": ["a"]},
    "inpaint": {"region": ["top"]},
    "transfer": {"region": ["top"]},
}


def smallest(method: str, **changes: object) -> dict[str, object]:
    """Parameters without those that have a default."""
    fields = dataclasses.fields(REQUESTS[method])
    needed = [field.name for field in fields if field.default is field.default_factory is dataclasses.MISSING]
    return {name: GIVEN[name] for name in needed if name in GIVEN} | OTHERWISE.get(method, {}) | changes


@pytest.mark.parametrize("method", REQUESTS)
def test_defaults_are_within_their_own_limits(method):
    made = read(REQUESTS[method], smallest(method))
    assert read(REQUESTS[method], json.loads(json.dumps(written(made)))) == made
    assert set(field_types(REQUESTS[method])) == set(vars(made))


def test_defaults_are_the_whole_picture_in_colour():
    params = read(DrawRequest, smallest("draw"))
    assert (params.size, params.corner) == ((64, 48), (0, 0))
    assert (params.view, params.step, params.background, params.solids) == ("colour", 0.004, None, None)
    assert params.people == [PosedPerson(Path("h"), STILL, [STILL] * 24, None)]


def test_a_regions_corner_is_counted_from_the_top():
    params = read(DrawRequest, smallest("draw", region=[10, 5, 20, 30]))
    assert (params.size, params.corner) == ((20, 30), (10, 13))


@pytest.mark.parametrize(
    ("method", "changes", "field"),
    [
        ("draw", {"region": [0, 0, 0, 10]}, "region"),
        ("draw", {"region": [60, 0, 10, 10]}, "region"),
        ("draw", {"region": [-1, 0, 10, 10]}, "region"),
        ("draw", {"clip": [1.0, 0.5]}, "clip"),
        ("draw", {"clip": [math.nan, 5.0]}, "clip"),
        ("draw", {"intrinsics": [[0.0, 0, 32], *CAMERA[1:]]}, "intrinsics"),
        ("draw", {"intrinsics": [CAMERA[0], [3.0, 50.0, 24], CAMERA[2]]}, "intrinsics"),
        ("draw", {"intrinsics": [*CAMERA[:2], [0, 0, 0]]}, "intrinsics"),
        ("draw", {"people": [{"human": "h", "object": STILL}]}, "people[0].joints"),
        ("generate", {"picture_px": 1025}, "picture_px"),
        ("variations", {"seeds": []}, "seeds"),
        ("variations", {"seeds": list(range(65))}, "seeds"),
        ("variations", {"seeds": [4, 5, 4]}, "seeds"),
        ("interpolate", {"steps": 1}, "steps"),
        ("inpaint", {"region": []}, "region"),
        ("inpaint", {"weights": "w.npz"}, "region"),
        ("reconstruct", {"capture": None}, "capture"),
        ("reconstruct", {"pictures": ["a"]}, "capture"),
        ("reconstruct", {"seed": 3}, "seed"),
        ("fit_posture", {"pictures": []}, "pictures"),
        ("merge", {"humans": []}, "humans"),
        ("merge", {"people": GIVEN["people"]}, "humans"),
        ("merge_frames", {"voxel": 0.0}, "voxel"),
        ("gaussians", {"object": STILL}, "object"),
    ],
)
def test_wrong_values_are_named_in_one_sentence(method, changes, field):
    with pytest.raises(FieldError) as error:
        read(REQUESTS[method], smallest(method, **changes))
    assert error.value.field == field
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 300
