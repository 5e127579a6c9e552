"""One sentence says what is wrong with a request to draw, before any work."""

import copy
import math
from pathlib import Path

import pytest
from primdiffusion.commands.frame import PosedPerson
from primdiffusion.commands.render import DrawRequest
from primdiffusion.commands.request import read_request

STILL = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]
GOOD = {
    "frame": "f",
    "width": 64,
    "height": 48,
    "intrinsics": [[50.0, 0, 32], [0, 50.0, 24], [0, 0, 1]],
    "world_to_camera": STILL,
    "people": [{"human": "h", "object": STILL, "joints": [STILL] * 24}],
}


def read(**changes) -> DrawRequest:
    return read_request(DrawRequest, {**copy.deepcopy(GOOD), **changes}, "draw")


def person(**changes) -> list:
    return [{**copy.deepcopy(GOOD["people"][0]), **changes}]


def test_defaults_are_the_whole_picture_in_colour():
    params = read()
    assert (params.size, params.corner) == ((64, 48), (0, 0))
    assert (params.view, params.step, params.background, params.solids) == ("colour", 0.004, None, None)
    assert params.people == [PosedPerson(Path("h"), STILL, [STILL] * 24, None)]


def test_a_regions_corner_is_counted_from_the_top():
    params = read(region=[10, 5, 20, 30])
    assert (params.size, params.corner) == ((20, 30), (10, 13))


BROKEN = [[1.0, 0.0, 0.0, 0.0], [0.0, math.nan, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"width": 0}, "0 x 48"),
        ({"height": -3}, "64 x -3"),
        ({"region": [0, 0, 0, 10]}, "region"),
        ({"region": [60, 0, 10, 10]}, "inside the picture of 64 x 48"),
        ({"region": [-1, 0, 10, 10]}, "region"),
        ({"region": [0, 0, 10]}, "region"),
        ({"region": [0, 0, 10.5, 10]}, "region"),
        ({"view": "x-ray"}, "'colour', 'depth', 'alpha', 'boxes'"),
        ({"clip": [1.0, 0.5]}, "clip"),
        ({"clip": [math.nan, 5.0]}, "clip holds nan"),
        ({"clip": [0.1]}, "clip holds 1 entries"),
        ({"background": [0.1, 0.2]}, "background"),
        ({"background": [0.1, 0.2, "x"]}, "background holds 'x'"),
        ({"background": [0.1, 0.2, 1e300]}, "background holds 1e+300"),
        ({"background": [0.1, 0.2, -(10**400)]}, "background holds"),
        ({"step": 0}, "step"),
        ({"step": 1e-7}, "step"),
        ({"step": math.nan}, "step"),
        ({"intrinsics": [[0.0, 0, 32], [0, 50.0, 24], [0, 0, 1]]}, "focal"),
        ({"intrinsics": 3 * [[1.0, 2.0]]}, "intrinsics"),
        ({"intrinsics": [[True, 0, 32], [0, 50.0, 24], [0, 0, 1]]}, "intrinsics holds True"),
        ({"intrinsics": [[50.0, 0, 32], [0, 50.0, 24], [0, 0, 0]]}, "[0, 0, 1]"),
        ({"intrinsics": [[50.0, 0, 32], [3.0, 50.0, 24], [0, 0, 1]]}, "[0, fy, cy]"),
        ({"world_to_camera": BROKEN}, "world_to_camera holds nan"),
        ({"people": ["h"]}, "JSON object"),
        ({"people": person(object=BROKEN)}, "object holds nan"),
        ({"people": person(joints=[STILL] * 23)}, "23 entries instead of 24 x 3 x 4"),
        ({"people": person(joints=[STILL] * 23 + [BROKEN])}, "joints holds nan"),
        ({"people": person(betas=[1.0, math.inf])}, "betas holds inf"),
        ({"people": person(pose=1)}, "'pose'"),
        ({"people": [{"human": "h", "object": STILL}]}, "'joints'"),
        ({"people": None}, "people"),
    ],
)
def test_wrong_values_are_named_in_one_sentence(changes, message):
    with pytest.raises(ValueError) as error:
        read(**changes)
    assert message in str(error.value)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 300
