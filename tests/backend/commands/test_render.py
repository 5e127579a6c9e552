"""A request to draw is checked before any work: the first wrong value is named by its field."""

import copy
import math
from pathlib import Path

import pytest
from primdiffusion.formats.requests import DrawRequest, PosedPerson
from primdiffusion.formats.schema import FieldError
from primdiffusion.formats.schema import read as read_record

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
    return read_record(DrawRequest, {**copy.deepcopy(GOOD), **changes})


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
    ("changes", "field"),
    [
        ({"width": 0}, "width"),
        ({"height": -3}, "height"),
        ({"region": [0, 0, 0, 10]}, "region"),
        ({"region": [60, 0, 10, 10]}, "region"),
        ({"region": [-1, 0, 10, 10]}, "region"),
        ({"region": [0, 0, 10]}, "region"),
        ({"region": [0, 0, 10.5, 10]}, "region[2]"),
        ({"view": "x-ray"}, "view"),
        ({"clip": [1.0, 0.5]}, "clip"),
        ({"clip": [math.nan, 5.0]}, "clip"),
        ({"clip": [0.1]}, "clip"),
        ({"background": [0.1, 0.2]}, "background"),
        ({"background": [0.1, 0.2, "x"]}, "background"),
        ({"background": [0.1, 0.2, 1e300]}, "background"),
        ({"background": [0.1, 0.2, -(10**400)]}, "background"),
        ({"step": 0}, "step"),
        ({"step": 1e-7}, "step"),
        ({"step": math.nan}, "step"),
        ({"intrinsics": [[0.0, 0, 32], [0, 50.0, 24], [0, 0, 1]]}, "intrinsics"),
        ({"intrinsics": 3 * [[1.0, 2.0]]}, "intrinsics"),
        ({"intrinsics": [[True, 0, 32], [0, 50.0, 24], [0, 0, 1]]}, "intrinsics"),
        ({"intrinsics": [[50.0, 0, 32], [0, 50.0, 24], [0, 0, 0]]}, "intrinsics"),
        ({"intrinsics": [[50.0, 0, 32], [3.0, 50.0, 24], [0, 0, 1]]}, "intrinsics"),
        ({"world_to_camera": BROKEN}, "world_to_camera"),
        ({"people": ["h"]}, "people[0]"),
        ({"people": person(object=BROKEN)}, "people[0].object"),
        ({"people": person(joints=[STILL] * 23)}, "people[0].joints"),
        ({"people": person(joints=[STILL] * 23 + [BROKEN])}, "people[0].joints"),
        ({"people": person(betas=[1.0, math.inf])}, "people[0].betas[1]"),
        ({"people": person(pose=1)}, "people[0].pose"),
        ({"people": [{"human": "h", "object": STILL}]}, "people[0].joints"),
        ({"people": None}, "people"),
    ],
)
def test_wrong_values_are_named_in_one_sentence(changes, field):
    with pytest.raises(FieldError) as error:
        read(**changes)
    assert error.value.field == field
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 300
