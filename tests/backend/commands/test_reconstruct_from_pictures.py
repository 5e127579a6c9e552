"""Humans from plain pictures: the command line and the child's requests, without the child."""

import contextlib
import dataclasses
import io
import json

import numpy as np
import pytest
import torch
from PIL import Image
from primdiffusion import cli
from primdiffusion.body.model import BodyPose
from primdiffusion.commands import reconstruct as commands
from primdiffusion.commands.reconstruct import fit_posture
from primdiffusion.commands.session import Session
from primdiffusion.formats.requests import FitPostureRequest, ReconstructRequest
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.human import Human, framing, place
from primdiffusion.human_file import load_human
from primdiffusion.reconstruction import from_captures, from_pictures
from primdiffusion.reconstruction.posture_start import standing
from primdiffusion.render.march import march
from support.runs import ended_at_each_report
from support.tiny import tiny_model

FILES = ["depth.png", "front.png", "person.human.safetensors", "posture.json", "side.png"]
COLOURS = torch.tensor([30.0, -20.0, 5.0])


@pytest.fixture(autouse=True, scope="module")
def short():
    """Few steps in small pictures."""
    stages = [from_pictures.FitStage(48, from_pictures.Stage(4, 0.03), steps) for steps in (1, 0)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(from_pictures, "FIT_STAGES", stages)
        patch.setattr(from_captures, "PULLED_DESCENT", dataclasses.replace(from_captures.PULLED_DESCENT, steps=4))
        yield


@pytest.fixture(scope="module")
def picture(tmp_path_factory):
    """A standing person of the tiny model in reddish clothes, cut out."""
    model = tiny_model()
    prior = model.denoiser.prior
    human = Human(model.decode((prior.mean + prior.picture(COLOURS[None]))[0]), torch.zeros(10), {})
    primitives = place(human, standing(55.0, 55.0).map(lambda values: values[0]))
    seen = march(primitives, framing(primitives, 0.0, 96, 128))
    straight = seen.rgb / seen.alpha[..., None].clamp_min(1e-3)
    rgba = torch.cat([encode_srgb(straight.clamp(0, 1)), seen.alpha[..., None]], -1)
    path = tmp_path_factory.mktemp("picture") / "anna.png"
    Image.fromarray((255 * rgba).round().to(torch.uint8).numpy()).save(path)
    return path


def command(picture, checkpoint, out):
    return ["reconstruct", str(picture), "--checkpoint", str(checkpoint), "--out", str(out), "--size", "32"]


@pytest.fixture
def line(picture, checkpoint, tmp_path):
    return command(picture, checkpoint, tmp_path / "out")


@pytest.fixture(scope="module")
def made(picture, checkpoint, tmp_path_factory):
    """The folder that `line` writes, and what it prints; not to be changed."""
    folder, printed, said = tmp_path_factory.mktemp("made") / "out", io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(said):
        cli.main(command(picture, checkpoint, folder))
    return folder, printed.getvalue(), said.getvalue()


def test_a_picture_becomes_a_human_and_its_posture(made):
    out, printed, said = made
    assert sorted(path.name for path in out.iterdir()) == FILES
    human = load_human(out / "person.human.safetensors")
    assert human.provenance["reconstructed_from"] == ["anna.png"]
    red, green, _ = human.payload.rgb.transpose(0, 1).flatten(1).mean(1)
    assert red > green
    posture = json.loads((out / "posture.json").read_text())
    assert posture["betas"] == pytest.approx(human.betas.tolist(), abs=1e-4)
    assert "only one picture" in said
    assert "no pose was given" in said
    percent = posture["fit"]["percent"]
    assert f", fit {percent} %, " in printed
    assert (f"the fit is {percent} %" in said) == (percent < 85)


def test_the_posture_can_be_used_again_without_refining(made, line, tmp_path):
    cli.main([*line, "--pose", str(made[0] / "posture.json"), "--no-refine"])
    before, after = (json.loads((folder / "posture.json").read_text()) for folder in (made[0], tmp_path / "out"))
    for key in ("pose", "translation", "betas"):
        assert np.allclose(before[key], after[key], atol=2e-5)
    assert np.allclose(before["cameras"]["camera0000"]["K"], after["cameras"]["camera0000"]["K"], atol=0.05)


def test_a_photograph_without_a_mask_is_cut_out_by_the_body_posed_over_it(made, line, picture, tmp_path, capsys):
    pytest.importorskip("cv2")
    cut = Image.open(picture)
    plain = Image.new("RGB", cut.size, (40, 160, 60))
    plain.paste(cut, mask=cut)
    plain.save(tmp_path / "plain.png")
    cli.main(["reconstruct", str(tmp_path / "plain.png"), *line[2:], "--pose", str(made[0] / "posture.json")])
    assert "look at mask.png" in capsys.readouterr().err
    mask, true = np.asarray(Image.open(tmp_path / "out" / "mask.png")) > 127, np.asarray(cut)[..., 3] > 127
    assert mask.shape == true.shape
    assert (mask & true).sum() / (mask | true).sum() > 0.9


def test_backs_to_choose_from_are_the_humans_of_their_seeds(made, line, tmp_path):
    cli.main([*line, "--backs", "2"])
    out, alone = tmp_path / "out", tmp_path / "alone"
    backs = ["0.human.safetensors", "0.png", "1.human.safetensors", "1.png"]
    assert sorted(path.name for path in out.iterdir()) == sorted([*FILES, *backs])
    assert Image.open(out / "1.png").size == (32, 32)
    cli.main([*line, "--seed", "1", "--out", str(alone)])
    person, *others = (load_human(out / f"{name}.human.safetensors") for name in ("person", "0", "1"))
    for one, folder in ((person, made[0]), (others[1], alone)):
        again = load_human(folder / "person.human.safetensors")
        assert torch.equal(one.payload.rgb, again.payload.rgb)
        assert one.provenance == again.provenance
    assert [human.provenance["seed"] for human in others] == [0, 1]
    assert not torch.equal(others[0].payload.rgb, others[1].payload.rgb)


def test_progress_never_goes_back_and_says_how_long_it_takes(picture, checkpoint, tmp_path, monkeypatch):
    monkeypatch.setattr(commands, "SURE_AFTER_S", 0.0)
    monkeypatch.setattr(commands, "POSTURE_STEPS", 9)  # those of `short`
    request = ReconstructRequest(pictures=(picture,), out_dir=tmp_path, checkpoint=checkpoint, size=32, backs=1)
    told = []
    commands.reconstruct(request, Session(), lambda *about, **_: told.append(about))
    shares = [step / total for _, step, total, _ in told]
    assert shares == sorted(shares)
    assert shares[-1] == 1
    left = [about[3] for about in told if about[0] == "fit"]
    assert all(seconds > 0 for seconds in left[:-1])
    assert left[-1] == 0


def test_two_pictures_have_a_pose_and_a_camera_each(line, picture, tmp_path):
    line.insert(1, str(picture))
    pose = BodyPose.rest(2)
    np.savez(tmp_path / "pose.npz", poses=np.zeros((2, 72)) + 0.01)
    cli.main([*line, "--pose", str(tmp_path / "pose.npz")])
    posture = json.loads((tmp_path / "out" / "posture.json").read_text())
    assert len(posture["pose"]) == len(posture["cameras"]) == len(pose.translation)


def test_a_fit_alone_writes_the_posture_and_can_be_cancelled_at_every_report(picture, checkpoint, tmp_path):
    request = FitPostureRequest(pictures=(picture,), out_dir=tmp_path / "out", checkpoint=checkpoint)
    answer, reports = ended_at_each_report(lambda report: fit_posture(request, Session(), report), tmp_path / "out")
    assert answer.posture == tmp_path / "out" / "posture.json"
    assert answer.fit == json.loads(answer.posture.read_text())["fit"]["percent"]
    assert not any("sides" in warning for warning in answer.warnings)  # a fit makes none
    assert [report[0] for report in reports[:2]] == ["load", "read"]


def test_impossible_requests_are_one_sentence_and_leave_nothing(line, picture, tmp_path, fails):
    plain, poses, cameras = (tmp_path / name for name in ("plain.jpg", "poses.npz", "cameras.json"))
    Image.open(picture).convert("RGB").save(plain)
    np.savez(poses, poses=np.zeros((3, 72)))
    cameras.write_text("[]")
    for words, named in (
        (["reconstruct", plain, *line[2:]], "mask"),
        ([*line, "--pose", poses], "3 poses for 1 pictures"),
        ([*line, "--cameras", cameras], "cameras.json"),
        ([*line, "--no-refine"], "without refining"),
    ):
        failed = fails(*words)
        assert failed.code == 1
        assert named in failed.err.splitlines()[-1]
        assert not (tmp_path / "out").exists()
