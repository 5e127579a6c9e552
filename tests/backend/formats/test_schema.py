"""Declared records: what is read, what is rejected and by which name, and that a record survives its JSON."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Annotated, Literal

import pytest
from primdiffusion.files.json_files import parse_message
from primdiffusion.formats.requests import REQUESTS, DrawRequest, PosedPerson
from primdiffusion.formats.schema import (
    Ending,
    FieldError,
    Length,
    Open,
    Range,
    Shape,
    descriptions,
    field_types,
    read,
    written,
)


@dataclasses.dataclass(frozen=True)
class Camera:
    name: str
    angle: Annotated[float, Range(-180, 180)] = 0.0


@dataclasses.dataclass(frozen=True)
class Settings:
    count: Annotated[int, Range(1, 1000)]
    """How many,
    at most."""
    scale: float = 1.0
    note: str | None = None
    pose: Path | list | None = None
    kind: Literal["a", "b"] = "a"
    sizes: tuple[int, ...] = ()
    seeds: Annotated[list[int], Length(1, 3)] = dataclasses.field(default_factory=lambda: [1])
    words: dict[Annotated[str, Length(1)], str | float] = dataclasses.field(default_factory=dict)
    matrix: Annotated[list, Shape((2, 3))] | None = None
    picture: Annotated[Path, Ending((".png", ".jpg"))] = Path("a.png")
    cameras: list[Camera] = dataclasses.field(default_factory=list)
    first: int = 0
    last: int = 0

    def check(self) -> None:
        if self.first > self.last:
            raise FieldError(("first",), f"is {self.first}, after the last, {self.last}: give less")


class Newer(Settings, Open):
    pass


def test_values_get_their_types_and_defaults():
    assert read(Settings, {"count": 2, "scale": 3}) == Settings(2, 3)
    assert read(Settings, {"count": 2, "pose": [1]}).pose == [1]
    assert read(Settings, {"count": 2, "pose": "p.npz"}).pose == Path("p.npz")
    assert read(Settings, {"count": 2, "sizes": [3, 4]}).sizes == (3, 4)
    assert read(Settings, {"count": 2, "words": {"a": "b", "c": 1.5}}).words == {"a": "b", "c": 1.5}
    assert read(Settings, {"count": 2, "cameras": [{"name": "x"}]}).cameras == [Camera("x")]
    assert read(Settings, {"count": 2, "picture": "B.JPG"}).picture == Path("B.JPG")


@pytest.mark.parametrize(
    ("value", "field"),
    [
        ({}, "count"),
        ({"colour": 2}, "colour"),
        ({"count": "1"}, "count"),
        ({"count": 1.0}, "count"),
        ({"count": 0}, "count"),
        ({"count": 1001}, "count"),
        ({"count": 2.0**63}, "count"),
        ({"count": math.inf}, "count"),
        ({"count": math.nan}, "count"),
        ({"count": True}, "count"),
        ({"count": None}, "count"),
        ({"scale": "2"}, "scale"),
        ({"scale": False}, "scale"),
        ({"scale": math.nan}, "scale"),
        ({"scale": 10**400}, "scale"),
        ({"note": 2}, "note"),
        ({"note": "half \ud800"}, "note"),
        ({"pose": {}}, "pose"),
        ({"pose": ""}, "pose"),
        ({"pose": "a\0b"}, "pose"),
        ({"pose": "\ud800"}, "pose"),
        ({"pose": "x" * 50_000}, "pose"),
        ({"kind": "c"}, "kind"),
        ({"kind": ["a"]}, "kind"),
        ({"sizes": [1, 2.5]}, "sizes[1]"),
        ({"seeds": []}, "seeds"),
        ({"seeds": [1, 2, 3, 4]}, "seeds"),
        ({"words": {"x": None}}, "words.x"),
        ({"words": {"": 1}}, "words.''"),
        ({"words": {"a\nb": None}}, r"words.'a\nb'"),
        ({"not a name " * 50: 1}, "'" + ("not a name " * 50)[:59]),
        ({"words": []}, "words"),
        ({"matrix": [[1, 2, 3]]}, "matrix"),
        ({"matrix": [[1, 2, 3], [4, 5, True]]}, "matrix"),
        ({"matrix": [[1, 2, 3], [4, 5, 1e31]]}, "matrix"),
        ({"picture": "human.safetensors"}, "picture"),
        ({"cameras": ["x"]}, "cameras[0]"),
        ({"cameras": [{"name": "x"}, {}]}, "cameras[1].name"),
        ({"cameras": [{"name": "x", "angle": 181}]}, "cameras[0].angle"),
        ({"cameras": [{"name": "x", "zoom": 1}]}, "cameras[0].zoom"),
        ({"first": 2, "last": 1}, "first"),
    ],
)
def test_a_wrong_value_is_named_by_its_field_in_one_sentence(value, field):
    values = value if not value or "count" in value else {"count": 1, **value}
    with pytest.raises(FieldError) as error:
        read(Settings, values, "m")
    assert error.value.field == f"m.{field}"
    assert str(error.value).startswith(f"m.{field} ")
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 300


def test_the_sentence_says_what_to_give():
    with pytest.raises(FieldError, match=r"^steps is 0: give an integer from 1 to 1000$"):
        read(REQUESTS["generate"], {"seed": 1, "out_dir": "x", "steps": 0})


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        ({"picture": Path("x/a.gif")}, "picture is 'x/a.gif': give"),
        ({"pose": Path("x" * 40_000)}, "pose is 'xxx"),
        ({"sizes": (Path("a"), 2)}, "sizes[0] is 'a': give"),
        ({"cameras": (Path("a"),)}, "cameras[0] is 'a': give"),
        ({"seeds": (Path("a"),) * 4}, "seeds is ['a', 'a', 'a', 'a']: give"),
        ({"first": 2**64}, "give an integer from -2^63 + 1 to 2^63 - 1"),
        ({"count": 0}, "give an integer from 1 to 1000"),
    ],
)
def test_paths_and_limits_are_written_as_people_write_them(value, shown):
    with pytest.raises(FieldError) as error:
        read(Settings, {"count": 1, **value})
    assert str(error.value).startswith(shown) or str(error.value).endswith(shown)


def test_limits_themselves_are_allowed():
    for count in (1, 1000):
        assert read(Settings, {"count": count}).count == count
    assert read(Settings, {"count": 1, "cameras": [{"name": "", "angle": -180}]}).cameras[0].angle == -180


def test_a_newer_programs_values_are_left_out_of_open_records():
    assert read(Newer, {"count": 1, "colour": 2}) == Newer(1)


def test_a_record_is_read_again_from_its_json():
    record = Settings(3, 0.5, None, Path("p"), "b", (1, 2), [3], {"a": 1.0}, [[1, 2, 3]] * 2, cameras=[Camera("x", 9)])
    assert read(Settings, parse_message(json.dumps(written(record)))) == record


def test_a_records_own_values_are_read_again_as_a_command_line_gives_them():
    record = Settings(3, pose=Path("p"), sizes=(1, 2), cameras=[Camera("x", 9)])
    assert read(Settings, vars(record)) == record


def test_the_strings_below_fields_are_their_descriptions():
    assert descriptions(Settings) == {"count": "How many, at most."}


STILL = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]


CAMERA = [[50.0, 0, 32], [0, 50.0, 24], [0, 0, 1]]


GIVEN = {
    "seed": 1, "seeds": [1], "id": 1, "region": ["top"], "voxel": 0.01, "width": 64, "height": 48, "out": "a.png",
    **dict.fromkeys(("person", "other", "source", "out_dir", "human", "frame"), "a"),
    "world_to_camera": STILL, "intrinsics": CAMERA, "people": [{"human": "h", "object": STILL, "joints": [STILL] * 24}],
}  # fmt: skip


OTHERWISE = {
    "gaussians": {"out": "a.ply", "person": {"human": "h", "object": STILL, "joints": [STILL] * 24}},
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
        ("merge", {"people": []}, "people"),
        ("merge", {"voxel": 0.0}, "voxel"),
        ("gaussians", {"person": {"human": "h", "object": STILL}}, "person.joints"),
    ],
)
def test_wrong_values_are_named_in_one_sentence(method, changes, field):
    with pytest.raises(FieldError) as error:
        read(REQUESTS[method], smallest(method, **changes))
    assert error.value.field == field
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 300
