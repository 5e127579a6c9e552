"""`primdiffusion payloads encode`: captures in, training payloads out."""

import json

import numpy as np
import pytest
import torch
from capture_scenes import captured
from primdiffusion import cli
from primdiffusion.capture.conditioning import captured_person
from primdiffusion.capture.reader import open_captures
from primdiffusion.encoder.model import load_encoder
from primdiffusion.formats.capture_layout import picture_path
from primdiffusion.formats.requests import EncodeSettings
from primdiffusion.people.stored_people import PersonFolder, read_payloads
from primdiffusion.primitives.primitives import K, S
from primdiffusion.training.captured_people import choose_frames, encode_people, read_cards
from support.tiny import save_tiny_encoder, tiny_encoder

AS_ENCODED = EncodeSettings()
FIRST, SECOND = "person_000000", "person_000001"


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Captures of two people in two frames from four sides, an encoder, and what is known of the first."""
    root = tmp_path_factory.mktemp("encode")
    captured(root, frames=2, passes=("img", "mask"))
    save_tiny_encoder(root / "tiny.safetensors")
    card = {"seed": 7, "betas": [0.0] * 10, "attributes": {"outfit": "suit", "height": 1.8}}
    (root / "people" / FIRST / "person.json").write_text(json.dumps(card))
    return root


@pytest.fixture
def line(root, tmp_path):
    words = ("--captures", root / "captures", "--encoder", root / "tiny.safetensors", "--out", tmp_path / "out")
    return ["payloads", "encode", *map(str, words)]


def outcomes(root, out, settings=AS_ENCODED, cards=None, model=None):
    work = encode_people(model or tiny_encoder(), open_captures(root / "captures"), out, settings, cards)
    return [(outcome.subject, outcome.status) for outcome in work]


def test_the_file_holds_what_the_encoder_makes_of_the_pictures(root, line, tmp_path, capsys):
    cli.main([*line, "--people", str(root / "people"), "--views", "3"])
    assert capsys.readouterr().out.splitlines() == [f"{FIRST}  done", f"{SECOND}  done  attributes unknown"]
    stored = read_payloads(tmp_path / "out" / f"{FIRST}.npz")
    person = captured_person(root / "captures", FIRST, views=3)
    wanted = load_encoder(root / "tiny.safetensors").encode(person.views, person.betas)
    got = stored.payload(0)
    assert stored.voxels.shape == (1, K, S, S, S, 4)
    assert torch.allclose(got.delta_scale, wanted.delta_scale, rtol=1e-3)
    assert (got.delta_scale[:, :2] != 1).all()
    assert (got.density - wanted.density).abs().max() < 0.51 / 255 * stored.full_density
    assert torch.equal(stored.betas, person.betas)
    people = PersonFolder(tmp_path / "out")
    assert list(people.names) == [FIRST, SECOND]
    assert people.known(0)[0].keys() == {"outfit", "height", "weight"}
    assert people.known(0)[0]["outfit"] == "suit"
    assert people.known(1)[0].keys() == {"height", "weight"}


def test_looks_are_frames_from_the_first_to_the_last(root, tmp_path):
    assert choose_frames(20, 4) == [0, 5, 10, 15]
    assert choose_frames(2, 9) == [0, 1]
    outcomes(root, tmp_path, EncodeSettings(looks=2))
    voxels = read_payloads(tmp_path / f"{FIRST}.npz").voxels
    assert len(voxels) == 2
    assert not torch.equal(voxels[0], voxels[1])


def test_refinement_moves_the_payload_towards_the_pictures_and_is_repeatable(root, tmp_path):
    rough, fine = AS_ENCODED, EncodeSettings(refine_steps=2, refine_size=16)
    for name, settings in (("rough", rough), ("fine", fine), ("again", fine)):
        next(encode_people(tiny_encoder(), open_captures(root / "captures"), tmp_path / name, settings))
    one, two, three = (read_payloads(tmp_path / name / f"{FIRST}.npz") for name in ("rough", "fine", "again"))
    assert not torch.equal(one.voxels, two.voxels)
    assert torch.equal(two.voxels, three.voxels)
    assert torch.equal(two.delta_scale, three.delta_scale)
    with np.load(tmp_path / "fine" / f"{FIRST}.npz") as file:
        source = json.loads(str(file["source"]))
    assert (source["captured"], source["refine_steps"], source["encoder"]["name"]) == (FIRST, 2, "tiny encoder")


def test_a_second_run_keeps_what_is_whole_and_of_the_same_source(root, tmp_path):
    outcomes(root, tmp_path)
    content = (tmp_path / f"{SECOND}.npz").read_bytes()
    (tmp_path / f"{SECOND}.npz").write_bytes(content[:500])
    assert outcomes(root, tmp_path) == [(FIRST, "skipped"), (SECOND, "done")]
    assert (tmp_path / f"{SECOND}.npz").read_bytes() == content
    other = tiny_encoder()
    other.encoder.scale_out.bias.data += 1
    assert outcomes(root, tmp_path, model=other) == [(FIRST, "done"), (SECOND, "done")]
    assert outcomes(root, tmp_path, EncodeSettings(views=2), model=other) == [(FIRST, "done"), (SECOND, "done")]
    assert outcomes(root, tmp_path, EncodeSettings(views=2), read_cards(root / "people"), other)[0][1] == "done"


def test_one_who_fails_is_named_and_the_others_are_made(tmp_path, fails):
    captured(tmp_path, frames=1, passes=("img", "mask"))
    encoder = save_tiny_encoder(tmp_path / "tiny.safetensors")
    picture_path(tmp_path / "captures" / FIRST, "mask", 1, 0).write_bytes(b"nothing")
    words = ("--captures", tmp_path / "captures", "--encoder", encoder, "--out", tmp_path / "out")
    failed = fails("payloads", "encode", *words)
    assert f"{FIRST}  failed" in failed.out
    assert "0000.png" in failed.out
    assert "1 of 2 humans failed" in failed.err
    assert [path.name for path in (tmp_path / "out").glob("*.npz")] == [f"{SECOND}.npz"]
