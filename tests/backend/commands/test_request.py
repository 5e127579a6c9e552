"""Requests read from JSON: types, defaults, and the name of what is wrong."""

import dataclasses
import math
from pathlib import Path
from typing import Literal

import pytest
from primdiffusion.commands.export import GaussiansRequest
from primdiffusion.commands.merge import MergeRequest
from primdiffusion.commands.render import RenderRequest
from primdiffusion.commands.request import ParameterError, read_request


@dataclasses.dataclass(frozen=True)
class Params:
    count: int
    scale: float = 1.0
    name: str | None = None
    pose: Path | list | None = None
    kind: Literal["a", "b"] = "a"
    sizes: tuple[int, ...] = ()
    words: dict[str, str | float] = dataclasses.field(default_factory=dict)

    def check(self) -> None:
        if self.count < 0:
            raise ValueError(f"count {self.count} is negative")


@pytest.mark.parametrize("path", ["", "a\0b", "\ud800"])
def test_a_path_that_no_system_has_is_named_by_its_parameter(path):
    with pytest.raises(ParameterError, match=r"m\.pose must be"):
        read_request(Params, {"count": 2, "pose": path}, "m")


def test_parameters_get_their_defaults_and_whole_numbers_pass_for_floats():
    assert read_request(Params, {"count": 2, "scale": 3}, "m") == Params(2, 3)
    assert read_request(Params, {"count": 2, "pose": [1]}, "m").pose == [1]
    assert read_request(Params, {"count": 2, "pose": "p.npz"}, "m").pose == Path("p.npz")
    assert read_request(Params, {"count": 2, "sizes": [3, 4]}, "m").sizes == (3, 4)
    assert read_request(Params, {"count": 2, "words": {"a": "b", "c": 1.5}}, "m").words == {"a": "b", "c": 1.5}


@pytest.mark.parametrize(
    ("params", "named"),
    [
        ({}, "count"),
        ({"count": 1, "colour": 2}, "colour"),
        ({"count": "1"}, "count"),
        ({"count": 1.0}, "count"),
        ({"count": 2.0**63}, r"m\.count is 9\.22337e\+18: integers go up to 2\^63-1"),
        ({"count": -math.inf}, r"m\.count is -inf: integers go down to 1-2\^63"),
        ({"count": math.nan}, "count must be an integer"),
        ({"count": True}, "count"),
        ({"count": None}, "count"),
        ({"count": 1, "scale": "2"}, "scale"),
        ({"count": 1, "scale": False}, "scale"),
        ({"count": 1, "name": 2}, "name"),
        ({"count": 1, "pose": {}}, "pose"),
        ({"count": 1, "pose": ""}, "pose"),
        ({"count": 1, "kind": "c"}, "kind"),
        ({"count": 1, "sizes": [1, 2.5]}, "sizes"),
        ({"count": 1, "words": {"x": None}}, "words"),
        ({"count": 1, "words": []}, "words"),
        ({"count": -1}, "count -1 is negative"),
    ],
)
def test_a_wrong_parameter_is_named(params, named):
    with pytest.raises(ValueError, match=named):
        read_request(Params, params, "m")


@pytest.mark.parametrize(
    "request_for",
    [
        lambda out: GaussiansRequest(person=Path("anna.human"), out=out),
        lambda out: RenderRequest(human=Path("anna.human"), out=out),
        lambda out: RenderRequest(human=Path("anna.human"), out=Path("a.png"), depth=out),
        lambda out: MergeRequest(people=[], out=out),
    ],
)
def test_a_human_is_no_output(request_for):
    with pytest.raises(ValueError, match="none of the extensions"):
        request_for(Path("anna.human.safetensors")).check()
