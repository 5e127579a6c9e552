"""Boxes placed in Blender are where the backend puts them; people's files are read or rejected in one sentence."""

import dataclasses
import os
import subprocess
from types import SimpleNamespace

import numpy as np
import pytest
from engine_stage import PYTHON, ROOT
from support.errors import refused

from blender_primdiffusion.engine.boxes import BoxRig, boxes_of
from blender_primdiffusion.engine.picture import PosedHuman
from blender_primdiffusion.scene.human_file import default_body, read_payload, read_sizes, read_tensors

pytestmark = pytest.mark.any_blender
CASES = 12


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> dict[str, SimpleNamespace]:
    """A human of the default body and one of their own, and where the backend puts their boxes."""
    root = tmp_path_factory.mktemp("boxes")
    command = [PYTHON, str(ROOT / "tests/blender/boxes_oracle.py"), str(root), str(CASES)]
    subprocess.run(command, env={**os.environ, "PYTHONPATH": str(ROOT / "backend")}, check=True)
    found = {}
    for kind in ("default", "own"):
        with np.load(root / kind / "cases.npz") as cases:
            file = root / kind / "person.human.safetensors"
            found[kind] = SimpleNamespace(file=file, kind=kind, cases=dict(cases))
    return found


@pytest.fixture
def plain(made):
    return made["default"]


@pytest.fixture(params=["default", "own"])
def person(request, made):
    return made[request.param]


def posed(person, case: int = 0, **changes) -> PosedHuman:
    cases = person.cases
    human = PosedHuman(
        file=person.file,
        object_to_world=cases["object"][case].astype(np.float64),
        joints=cases["joints"][case].astype(np.float64),
        betas=None if case % 3 == 0 else cases["betas"][case].tolist(),
        pelvis=np.zeros(3),
    )
    return dataclasses.replace(human, **changes)


@pytest.mark.parametrize("case", range(CASES))
def test_boxes_are_where_the_backend_places_them(person, case):
    boxes, expected = boxes_of(posed(person, case)), {name: values[case] for name, values in person.cases.items()}
    tolerance = 3e-5 * max(1.0, 1 / float(expected["density_scale"]))  # metres; the backend computes in float32
    assert np.abs(boxes.position - expected["position"]).max() < tolerance
    sides = boxes.rotation * boxes.half_extent[:, None]
    assert np.abs(sides - expected["rotation"] * expected["half_extent"][:, None]).max() < tolerance
    np.testing.assert_allclose(boxes.half_extent, expected["half_extent"], rtol=1e-4)
    assert boxes.density_scale == pytest.approx(expected["density_scale"], rel=1e-4)
    mirrored = np.linalg.det(expected["object"][:, :3]) < 0
    assert (np.linalg.det(boxes.rotation) < 0).all() == mirrored


def test_a_body_with_another_number_of_boxes_is_rejected(plain):
    model = default_body()
    per_box = ("face", "barycentric", "stencil_vertex", "stencil_du", "stencil_dv", "rest_half_extent")
    fewer = dataclasses.replace(model, **{name: getattr(model, name)[:4] for name in per_box})
    with refused(ValueError, plain.file.name):
        BoxRig(fewer).place(posed(plain), read_sizes(plain.file))


def test_what_is_scaled_to_zero_is_rejected_by_name(plain):
    human = posed(plain)
    with refused(ValueError, "scale is 0"):
        boxes_of(dataclasses.replace(human, object_to_world=human.object_to_world * [0, 0, 0, 1]))
    human.joints[4, :, :3] = 0
    with refused(ValueError, "left_knee"):
        boxes_of(human)


def test_a_payload_is_read_as_the_backend_wrote_it(person):
    payload = read_payload(person.file)
    assert payload.rgb.shape == (1024, 3, 8, 8, 8)
    for name in ("rgb", "density", "delta_scale", "betas"):
        dtype, shape, raw = read_tensors(person.file).arrays[name]
        assert dtype == "F32"
        np.testing.assert_array_equal(getattr(payload, name), np.frombuffer(raw, "<f4").reshape(shape))
    assert (payload.rest_half_extent is None) == (person.kind == "default")


def test_sizes_are_read_once(plain):
    first = read_sizes(plain.file)
    assert read_sizes(plain.file) is first
    assert first.rgb.size == first.density.size == 0
