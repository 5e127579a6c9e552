"""Requests read from JSON: types, defaults, and the name of what is wrong."""

import dataclasses
import math
from pathlib import Path
from typing import Literal

import pytest
from primdiffusion.commands import request as module
from primdiffusion.commands.export import GaussiansRequest
from primdiffusion.commands.merge import MergeRequest
from primdiffusion.commands.render import RenderRequest
from primdiffusion.commands.request import Pace, ParameterError, read_request


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


def paced(monkeypatch, steps: list[float]) -> list[float | None]:
    """Estimates after steps of these seconds."""
    now, pace, found = 0.0, Pace(), []
    for done, step in enumerate(steps, 1):
        now += step
        monkeypatch.setattr(module.time, "perf_counter", lambda now=now: now)
        found.append(pace.left(done, len(steps)))
    return found


def test_the_time_left_leaves_out_loading_and_compiling(monkeypatch):
    steps = [90.0, 4.0, 60.0, 4.0, 5.0, *([4.0] * 25)]  # the marcher is compiled for a preview in the third
    found = paced(monkeypatch, steps)
    assert found[:2] == [None, None]
    for done in range(3, len(steps)):
        assert found[done - 1] == pytest.approx(sum(steps[done:]), rel=0.15)
    assert found[-1] == 0


def test_the_time_left_follows_a_machine_that_becomes_slow(monkeypatch):
    found = paced(monkeypatch, [1.0] * 20 + [10.0] * 20)
    assert found[18] == pytest.approx(21)
    assert found[30] == pytest.approx(90)


def test_a_single_step_leaves_nothing_to_wait_for(monkeypatch):
    assert paced(monkeypatch, [30.0]) == [0]
