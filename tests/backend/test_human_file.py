"""People on disk: whole, exact, and rejected with a sentence where they are not."""

import dataclasses
import json
import os

import numpy as np
import pytest
import safetensors.torch
import torch
from primdiffusion.body.model import default_body
from primdiffusion.files import tensor_file
from primdiffusion.files.regular_files import FileError
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.human import Human, framing, generate, place
from primdiffusion.human_file import load_human, save_body, save_human
from primdiffusion.primitives.anchors import default_anchors
from primdiffusion.primitives.primitives import K
from primdiffusion.render.march import march
from support.errors import refused
from support.tiny import tiny_model


@pytest.fixture(scope="module")
def human() -> Human:
    person = generate(tiny_model(), seed=3, steps=3)
    scale = torch.linspace(0.8, 1.3, K * 3).reshape(K, 3)
    return dataclasses.replace(person, payload=dataclasses.replace(person.payload, delta_scale=scale))


def test_a_saved_person_comes_back_bit_for_bit(human, tmp_path):
    path = tmp_path / "person.human.safetensors"
    save_human(path, human)
    back = load_human(path)
    for name in ("rgb", "density", "delta_scale"):
        assert torch.equal(getattr(back.payload, name), getattr(human.payload, name))
    assert torch.equal(back.betas, human.betas)
    assert back.provenance == human.provenance
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16, torch.float64])
def test_numbers_of_other_precision_become_float32(human, tmp_path, kind):
    path = tmp_path / "person.human.safetensors"
    save_human(path, human)
    tensors, metadata = tensor_file.read(path)
    path.write_bytes(tensor_file.save({name: values.to(kind) for name, values in tensors.items()}, metadata))
    back = load_human(path)
    assert {value.dtype for value in (*vars(back.payload).values(), back.betas)} == {torch.float32}
    assert torch.equal(back.payload.delta_scale, human.payload.delta_scale.to(kind).float())


def test_a_compact_file_renders_as_the_whole_one_to_a_level_of_255(human, tmp_path):
    save_human(tmp_path / "a.human", human, compact=True)
    pictures = []
    for one in (human, load_human(tmp_path / "a.human")):
        primitives = place(one)
        view = march(primitives, framing(primitives, 17, 96, 96))
        pictures.append(torch.cat([encode_srgb(view.rgb.clamp(0, 1)), view.alpha[..., None]], -1))
    drawn = pictures[0][..., 3] > 0
    assert drawn.sum() > 500
    assert torch.quantile((pictures[1] - pictures[0])[drawn].abs(), 0.99) <= 1 / 255


def test_a_compact_file_with_a_single_colour_is_rejected(human, tmp_path):
    path = tmp_path / "a.human"
    save_human(path, human, compact=True)
    tensors, metadata = tensor_file.read(path)
    path.write_bytes(tensor_file.save({**tensors, "rgb": torch.zeros((), dtype=torch.uint8)}, metadata))
    with refused(ValueError, "a.human"):
        load_human(path)


META = {"format": "primdiffusion.human", "format_version": "1", "provenance": "{}"}


def written(path, tensors, **metadata) -> None:
    safetensors.torch.save_file(tensors, path, {**META, **metadata})


def rejected(path) -> str:
    """The sentence about the file, which is one and short."""
    with refused(FileError, path.name) as error:
        load_human(path)
    sentence = str(error.value).replace(f"{path.parent}{os.sep}", "")
    assert "\n" not in sentence
    assert len(sentence) < 300
    return sentence


@pytest.fixture(scope="module")
def stored(human, tmp_path_factory) -> dict[str, torch.Tensor]:
    """The tensors of a file."""
    path = tmp_path_factory.mktemp("stored") / "a.human.safetensors"
    save_human(path, human)
    return safetensors.torch.load_file(path)


def body_named(path: str | int) -> str:
    return json.dumps({"smpl": {"path": path, "sha256": "0" * 64}, "uv": []})


@pytest.mark.parametrize(
    ("entry", "text", "message"),
    [
        ("format", "pt", "without a human"),
        ("format_version", "9" * 5000, "format version"),
        ("format_version", "10", "format 10"),
        ("format_version", "one", "format version 'one'"),
        ("format_version", "0", "'0'"),
        ("body", "[" * 100_000, "malformed body metadata"),
        ("body", body_named(3), "malformed body metadata"),
        ("body", body_named("/proc/self/pagemap"), "/proc/self/pagemap has changed"),
        ("body", body_named("/dev/zero"), "/dev/zero cannot be read (this is not a regular file)"),
        ("body", body_named(r"\\server\share\smpl.pkl"), "is not named by a path on this machine"),
        ("provenance", "{", "provenance is not JSON"),
        ("provenance", "[" * 100_000, "nested more than 64 deep"),
        ("provenance", "[1]", "not a JSON object"),
        ("provenance", '{"seed": "seven"}', "'seed' of its provenance"),
        ("provenance", '{"steps": true}', "'steps'"),
        ("provenance", '{"checkpoint": null}', "'checkpoint'"),
        ("provenance", '{"guidance": NaN}', "provenance is not JSON (it holds NaN"),
        ("provenance", '{"attributes": ["sex"]}', "'attributes'"),
        ("provenance", '{"attributes": {"sex": null}}', "'attributes.sex'"),
        ("provenance", '{"edits": {"edit": "vary"}}', "'edits'"),
        ("provenance", '{"edits": [{"amount": 0.5}]}', "'edits[0].edit'"),
    ],
)
def test_metadata_that_are_none_of_a_human_are_rejected_by_their_entry(stored, tmp_path, entry, text, message):
    path = tmp_path / "odd.human.safetensors"
    written(path, stored, **{entry: text})
    assert message in rejected(path)


def test_a_file_of_the_first_release_is_read(stored, tmp_path):
    """Written before people had attributes, hashes and edits."""
    path = tmp_path / "old.human.safetensors"
    first = {"seed": 3, "steps": 3, "sampler": "ddim", "checkpoint": "tiny", "full_density": 100.0, "version": "0.1.0"}
    written(path, stored, provenance=json.dumps(first))
    assert load_human(path).provenance == first


def test_unknown_entries_of_the_provenance_are_saved(human, tmp_path):
    path = tmp_path / "person.human.safetensors"
    more = {**human.provenance, "studio": {"shot": [1, None]}, "edits": [{"edit": "vary", "amount": 0.5}]}
    save_human(path, dataclasses.replace(human, provenance=more))
    assert load_human(path).provenance == more


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"betas": torch.full((10,), -5.5)}, "beta"),
        ({"betas": torch.full((10,), float("nan"))}, "betas"),
        ({"provenance": {"edits": "many"}}, "edits"),
    ],
)
def test_what_could_not_be_read_again_is_not_written(human, tmp_path, change, message):
    with refused(ValueError, message):
        save_human(tmp_path / "file", dataclasses.replace(human, **change))
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def body_file(tmp_path_factory) -> dict[str, torch.Tensor]:
    path = tmp_path_factory.mktemp("body") / "body.safetensors"
    save_body(path, default_body(), default_anchors())
    tensors, metadata = tensor_file.read(path)
    assert metadata == {"format": "primdiffusion.body", "format_version": "1"}
    return tensors


def test_a_bodys_file_has_the_shapes_blender_expects(body_file):
    body = default_body()
    v, f = len(body.template), len(body.faces)
    assert {name: tuple(tensor.shape) for name, tensor in body_file.items()} == {
        "faces": (f, 3), "uv_corner": (f, 3, 2), "skin_weights": (v, 24), "template": (v, 3),
        "shape_basis": (v, 3, 10), "joint_template": (24, 3), "joint_basis": (24, 3, 10), "face": (K,),
        "barycentric": (K, 3), "stencil_vertex": (K, 64), "stencil_du": (K, 64), "stencil_dv": (K, 64),
        "rest_half_extent": (K, 3),
    }  # fmt: skip


def test_joints_in_a_bodys_file_follow_the_shape_as_the_bodys_do(body_file):
    betas = torch.linspace(-2, 2, 10)
    joints = body_file["joint_template"] + body_file["joint_basis"] @ betas
    np.testing.assert_allclose(joints, default_body().shape(betas).joints, atol=5e-6)


def test_a_body_with_correctives_has_those_of_the_vertices_it_needs(tmp_path):
    body, anchors = default_body(), default_anchors()
    basis = torch.randn(len(body.template), 3, 207, generator=torch.Generator().manual_seed(0))
    save_body(tmp_path / "body.safetensors", dataclasses.replace(body, pose_basis=basis), anchors)
    stored = tensor_file.read(tmp_path / "body.safetensors")[0]["pose_basis"]
    used = torch.cat([anchors.stencil_vertex.flatten(), body.faces[anchors.face].flatten()]).unique()
    assert stored.equal(basis[used])
