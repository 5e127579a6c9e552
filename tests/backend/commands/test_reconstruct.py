"""`primdiffusion reconstruct` and the child's job of the same name, without the child."""

import dataclasses
import json
import shutil

import numpy as np
import pytest
import torch
from capture_scenes import box, captured, save_person, small_job
from PIL import Image
from primdiffusion import cli
from primdiffusion.capture.conditioning import captured_person, choose_subject, conditioning_views
from primdiffusion.capture.render import render
from primdiffusion.commands import reconstruct as commands
from primdiffusion.commands.session import Session
from primdiffusion.encoder.model import EncoderModel
from primdiffusion.encoder.network import Encoder
from primdiffusion.formats.capture_layout import LIST_FILE, SMPL_FILE, SMPL_FOLDER, SMPL_PLAIN_FILE
from primdiffusion.formats.requests import ReconstructRequest
from primdiffusion.geometry.textured_mesh import TexturedMesh
from primdiffusion.human import place
from primdiffusion.human_file import load_human
from primdiffusion.reconstruction import from_captures
from primdiffusion.reconstruction.from_captures import reconstruct
from support.runs import ended_at_each_report
from support.tiny import TINY, save_tiny_checkpoint, save_tiny_encoder, tiny_encoder

FILES = ["depth.png", "front.png", "person.human.safetensors", "side.png"]
FIRST, SECOND = "person_000000", "person_000001"


@pytest.fixture(autouse=True)
def short(monkeypatch):
    """A few steps of descent."""
    for name in ("DESCENT", "PULLED_DESCENT"):
        monkeypatch.setattr(from_captures, name, dataclasses.replace(getattr(from_captures, name), steps=4))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Two people who fill the space about their bodies with green and white."""
    job = small_job(tmp_path_factory.mktemp("reconstruct"), frames=2, passes=("img", "mask"))
    for path, colour in zip(job.people.values(), [(0, 200, 0, 255), (255, 255, 255, 255)], strict=True):
        save_person(path, TexturedMesh((box(half=1.1, colour=colour),)))
    assert {outcome.status for outcome in render(job)} == {"done"}
    return job.out


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    return save_tiny_encoder(tmp_path_factory.mktemp("encoder") / "tiny.safetensors")


@pytest.fixture
def line(checkpoint, tmp_path):
    """The start of a command line that writes to tmp_path / "out"."""
    return ["reconstruct", "--checkpoint", str(checkpoint), "--out", str(tmp_path / "out"), "--size", "32"]


def test_the_command_writes_what_generate_writes_and_says_where_it_comes_from(dataset, line, tmp_path, capsys):
    cli.main([*line, "--capture", str(dataset), "--subject", FIRST, "--frame", "1", "--views", "3"])
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == FILES
    meta = load_human(tmp_path / "out" / "person.human.safetensors").provenance
    chosen = captured_person(dataset, FIRST, 1, 3).cameras
    assert (meta["reconstructed_from"], meta["frame"], meta["views"]) == (FIRST, 1, list(chosen))
    assert (meta["checkpoint"], meta["full_density"]) == ("tiny encoder", 100.0)
    captured_out = capsys.readouterr()
    assert captured_out.out.startswith(f"{tmp_path / 'out'}  {FIRST}, frame 1, 3 views, ")
    assert captured_out.err == ""
    with Image.open(tmp_path / "out" / "front.png") as picture:
        assert picture.size == (32, 32)


def test_the_person_has_the_colours_of_their_own_pictures(dataset, line, tmp_path):
    cli.run([*line, "--capture", str(dataset / FIRST)])
    picture = np.asarray(Image.open(tmp_path / "out" / "front.png")).astype(int)
    red, green, blue = picture[picture.sum(-1) > 60].mean(0)
    assert green > 3 * max(red, blue)


def test_the_person_is_what_the_encoder_makes_of_the_views(dataset, line, tmp_path):
    cli.run([*line, "--capture", str(dataset / SECOND)])
    kept = load_human(tmp_path / "out" / "person.human.safetensors")
    person = captured_person(dataset / SECOND)
    model = tiny_encoder()
    model.encoder.load_state_dict({key: value.half().float() for key, value in model.encoder.state_dict().items()})
    wanted = reconstruct(model, person)
    assert torch.allclose(kept.payload.rgb, wanted.payload.rgb, atol=1e-5)
    assert torch.equal(kept.betas, person.betas)


@pytest.mark.parametrize("frames", ["person", "template"])
def test_the_person_stands_on_the_body_that_the_encoders_boxes_sit_on(dataset, frames):
    model = EncoderModel(Encoder(dataclasses.replace(TINY, frames=frames)), {})
    person = dataclasses.replace(captured_person(dataset / SECOND), betas=torch.linspace(-1, 1, 10))
    human, pose = reconstruct(model, person), person.views.pose
    wanted = model.place(human.payload, person.betas, pose)
    assert torch.allclose(place(human, pose).position, wanted.position, atol=1e-6)


def test_a_dataset_in_the_released_layout_gives_the_same_person(dataset, line, tmp_path):
    cli.run([*line, "--capture", str(dataset), "--subject", FIRST])
    ours = load_human(tmp_path / "out" / "person.human.safetensors")
    released = tmp_path / "released" / FIRST
    for kind in ("img", "mask"):
        shutil.copytree(dataset / FIRST / kind, released / kind)
    shutil.copy(dataset / FIRST / "cameras.json", released)
    (released / SMPL_FOLDER).mkdir()
    shutil.copy(dataset / FIRST / SMPL_FOLDER / SMPL_FILE, released / SMPL_FOLDER)
    assert not (released / SMPL_FOLDER / SMPL_PLAIN_FILE).exists()
    (released.parent / LIST_FILE).write_text(f"{FIRST}\n")
    cli.run([*line, "--capture", str(released.parent)])
    theirs = load_human(tmp_path / "out" / "person.human.safetensors")
    assert torch.equal(ours.payload.rgb, theirs.payload.rgb)


def test_one_view_works_with_a_warning_that_the_rest_is_guessed(dataset, line, tmp_path, capsys):
    cli.main([*line, "--capture", str(dataset / FIRST), "--views", "1"])
    warning = "primdiffusion: warning: only one view: the sides that it does not show are guessed\n"
    assert capsys.readouterr().err == warning
    assert (tmp_path / "out" / "person.human.safetensors").exists()


def test_the_prior_fits_the_person_to_a_single_view(dataset, line, tmp_path):
    line[2] = str(save_tiny_checkpoint(tmp_path / "model.safetensors"))
    cli.run([*line, "--capture", str(dataset / FIRST), "--views", "1", "--by", "prior"])
    picture = np.asarray(Image.open(tmp_path / "out" / "front.png")).astype(int)
    red, green, blue = picture[picture.sum(-1) > 60].mean(0)
    assert green > 2 * max(red, blue)


def test_views_from_behind_alone_work(dataset):
    captures, name = choose_subject(dataset, FIRST)
    behind = [number for number, view in enumerate(captures.subject(name).views) if view.position[2] < 0]
    views = conditioning_views(captures, name, 0, behind)
    person = dataclasses.replace(captured_person(dataset, FIRST), cameras=tuple(behind), views=views)
    assert torch.isfinite(reconstruct(tiny_encoder(), person).payload.rgb).all()


def test_a_camera_that_has_the_person_at_its_back_changes_nothing(dataset, tmp_path):
    whole = reconstruct(tiny_encoder(), captured_person(dataset, FIRST))
    turned = shutil.copytree(dataset / FIRST, tmp_path / "turned" / FIRST)
    cameras = json.loads((turned / "cameras.json").read_text())
    about = cameras["camera0000"]
    away = np.diag([-1.0, 1.0, -1.0])
    cameras["camera0004"] = {**about, "R": (away @ about["R"]).tolist(), "T": (away @ about["T"]).tolist()}
    (turned / "cameras.json").write_text(json.dumps(cameras))
    for kind in ("img", "mask"):
        shutil.copytree(turned / kind / "camera0000", turned / kind / "camera0004")
    person = captured_person(turned)
    assert (person.cameras, person.warnings) == ((0, 1, 2, 3, 4), ())
    assert torch.allclose(reconstruct(tiny_encoder(), person).payload.rgb, whole.payload.rgb, atol=1e-4)


def test_the_request_can_be_ended_at_every_report(tmp_path, checkpoint):
    folder = captured(tmp_path, people=1, frames=1, passes=("img", "mask"))
    request = ReconstructRequest(capture=folder, out_dir=tmp_path / "out", checkpoint=checkpoint, size=32)
    session = Session()
    result, reports = ended_at_each_report(
        lambda report: commands.reconstruct(request, session, report), tmp_path / "out"
    )
    stages = [("load", 0), ("read", 1), ("encode", 2), ("write", 3), ("write", 4)]
    assert [report[:2] for report in reports] == stages
    assert result.subject == FIRST
    assert result.views == [0, 1, 2, 3]
    assert "is inside the masks" in result.warnings[0]
