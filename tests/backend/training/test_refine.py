"""Refining a person: tiny pictures of a person of random boxes, and the command on captures of boxes."""

import dataclasses
import subprocess
import sys

import numpy as np
import pytest
import torch
from capture_scenes import body_mesh, save_person
from primdiffusion import cli
from primdiffusion.body.model import BodyPose, J
from primdiffusion.capture.conditioning import conditioning_views
from primdiffusion.capture.dataset import stack
from primdiffusion.capture.poses import built_in_poses
from primdiffusion.capture.reader import Views, open_captures
from primdiffusion.capture.render import RenderJob, render
from primdiffusion.commands.reconstruct import split_cameras
from primdiffusion.formats.camera_rig import Rig
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.geometry.textured_mesh import TexturedMesh
from primdiffusion.human import Human, framing, place
from primdiffusion.human_file import load_human, save_human
from primdiffusion.primitives.primitives import K, Payload, S
from primdiffusion.render.descent import Adam, DescentSettings
from primdiffusion.render.march import march
from primdiffusion.training.refine import bare_body, refine, view_psnr
from support.errors import refused

QUICK = DescentSettings(steps=15, views=1, density_rate=0.01)
"""So few steps on so few pixels of random boxes: density, which is right at the start, must not run ahead of colour."""
FRONT, SIDE, BACK = 0.0, 90.0, 180.0


def person(seed: int) -> Human:
    """Boxes of one colour each, solid towards the body."""
    generator = torch.Generator().manual_seed(seed)
    rgb = torch.rand(K, 3, 1, 1, 1, generator=generator).expand(K, 3, S, S, S).clone()
    density = torch.linspace(100, -100, S).clamp_min(0)[:, None, None].expand(K, S, S, S).clone()
    return Human(Payload(rgb, density, torch.ones(K, 3)), torch.zeros(10), {"seed": seed})


def pose(turn: float) -> BodyPose:
    theta = torch.zeros(3 * J)
    theta[3 * 16 + 2] = turn  # the left shoulder
    return BodyPose.from_axis_angle(theta)


@torch.no_grad()
def views_of(human: Human, yaws=(FRONT, SIDE, BACK), turn: float = 0.0, size: int = 40) -> Views:
    primitives = place(human, pose(turn))
    cameras = stack([framing(primitives, yaw, size, size) for yaw in yaws])
    pictures = march(primitives, cameras)
    rgba = torch.cat([encode_srgb(pictures.rgb).clamp(0, 1), pictures.alpha[..., None]], dim=-1)
    return Views((rgba * 255).round().to(torch.uint8), cameras, pose(turn))


@pytest.fixture(scope="module")
def views() -> list[Views]:
    wanted = person(1)
    return [views_of(wanted), views_of(wanted, (29,), turn=-0.8)]


def test_a_person_comes_to_look_like_the_pictures_and_like_those_it_was_not_shown(views):
    start = person(2)
    unseen = [views_of(person(1), (FRONT + 11, BACK + 11), turn=-0.4)]
    before = float(view_psnr(start, unseen).mean())
    refined = refine(start, views, QUICK)
    assert refined.psnr_after > refined.psnr_before + 3
    assert float(view_psnr(refined.human, unseen).mean()) > before + 0.5
    assert refined.psnr_after == pytest.approx(float(view_psnr(refined.human, views).mean()), abs=1e-4)
    assert torch.equal(refined.human.betas, start.betas)
    assert refined.human.provenance["refined_steps"] == 15


def test_the_same_seed_gives_the_same_bits_and_another_seed_others(views):
    once, again, other = (
        refine(person(2), views, dataclasses.replace(QUICK, steps=4, seed=seed)).human.payload for seed in (3, 3, 4)
    )
    assert all(torch.equal(one, two) for one, two in zip(vars(once).values(), vars(again).values(), strict=True))
    assert not torch.equal(once.rgb, other.rgb)


def test_what_no_picture_shows_stays_bit_for_bit(views):
    start, whole = person(2), views[0]
    half = dataclasses.replace(whole, rgba=whole.rgba[:, :20], camera=whole.camera.crop(0, 0, 40, 20))
    payload = refine(start, [half], dataclasses.replace(QUICK, steps=4)).human.payload
    primitives = place(start)
    reach = primitives.half_extent.norm(dim=-1) + 0.2  # metres; a pixel is a tenth of that
    lowest_seen = float(primitives.position[:, 1].mean() - 0.05)
    below = primitives.position[:, 1] + reach < lowest_seen
    assert below.sum() > 20
    for name in ("rgb", "density", "delta_scale"):
        assert torch.equal(getattr(payload, name)[below], getattr(start.payload, name)[below])
    moved = (payload.rgb != start.payload.rgb).flatten(1).any(1)
    assert 0.1 < moved.float().mean() < 0.9


def test_boxes_keep_their_sizes_and_densities_their_limit_where_this_is_asked(views):
    start, settings = person(2), dataclasses.replace(QUICK, scale_rate=0, largest_density=100)
    payload = refine(start, views, settings).human.payload
    assert torch.equal(payload.delta_scale, start.payload.delta_scale)
    assert float(payload.density.max()) == pytest.approx(100)
    assert float(payload.rgb.min()) >= 0
    assert float(payload.rgb.max()) <= 1


def test_masks_alone_make_a_thin_person_in_black_solid():
    black = person(1)
    black = dataclasses.replace(black, payload=dataclasses.replace(black.payload, rgb=0 * black.payload.rgb))
    thin = dataclasses.replace(black, payload=dataclasses.replace(black.payload, density=0.02 * black.payload.density))
    settings = dataclasses.replace(QUICK, scale_rate=0)
    refined = refine(thin, [views_of(black)], settings).human.payload
    assert refined.density.sum() > 1.5 * thin.payload.density.sum()
    without = refine(thin, [views_of(black)], dataclasses.replace(settings, silhouette=0)).human.payload
    assert torch.equal(without.density, thin.payload.density)


def test_the_work_ends_when_its_owner_says_so(views):
    class Cancelled(Exception):
        pass

    seen = []

    def stop():
        seen.append(None)
        if len(seen) == 2:
            raise Cancelled

    with pytest.raises(Cancelled):
        refine(person(2), views, QUICK, stop)
    assert len(seen) == 2


@pytest.mark.parametrize(
    ("broken", "sentence"),
    [
        (lambda human, views: (human, []), "no views"),
        (lambda human, views: (human, [dataclasses.replace(views, rgba=views.rgba[:, :30])]), "their cameras see"),
        (lambda human, views: (human, [dataclasses.replace(views, rgba=views.rgba[..., :3])]), "uint8"),
        (lambda human, views: (human, [dataclasses.replace(views, rgba=views.rgba / 255)]), "uint8"),
        (lambda human, views: (human, [dataclasses.replace(views, pose=BodyPose.rest(3))]), "one pose a record"),
        (lambda human, views: (human, [dataclasses.replace(views, rgba=views.rgba * 0)]), "views 0 covers the subject"),
        (lambda human, views: (dataclasses.replace(human, betas=torch.zeros(300)), [views]), "another body"),
        (lambda human, views: (dataclasses.replace(human, betas=torch.full((10,), torch.nan)), [views]), "betas"),
    ],
)
def test_what_cannot_be_refined_is_rejected_in_a_sentence(views, broken, sentence):
    with refused(ValueError, sentence):
        refine(*broken(person(2), views[0]), QUICK)


def test_rates_that_lead_nowhere_end_in_a_sentence(views, monkeypatch):
    def lost(_view, payload, _settings):
        return torch.nan * sum(values.sum() for values in vars(payload).values())

    monkeypatch.setattr("primdiffusion.render.descent._loss", lost)
    with refused(ValueError, "step 1"):
        refine(person(2), views, QUICK)


def test_pictures_too_large_for_memory_are_named(views, monkeypatch):
    def full(*_):
        raise RuntimeError("[enforce fail at alloc_cpu.cpp] not enough memory: you tried to allocate 9 bytes")

    monkeypatch.setattr("primdiffusion.render.descent.march", full)
    with refused(MemoryError, "40 x 40 pixels"):
        refine(person(2), views, QUICK)


def test_cameras_are_held_out_evenly():
    assert split_cameras(12, 3)[0] == [2, 6, 10]
    assert split_cameras(4, 0) == ([], [0, 1, 2, 3])
    held, given = split_cameras(5, 4)
    assert sorted(held + given) == [0, 1, 2, 3, 4]
    with refused(ValueError, "0 to 3"):
        split_cameras(4, 4)


@pytest.fixture
def line(captures, tmp_path):
    save_human(tmp_path / "start.human.safetensors", person(2))
    start = ["--start", str(tmp_path / "start.human.safetensors"), "--out", str(tmp_path / "out")]
    return ["refine", "--capture", str(captures), "--subject", "person_000001", "--steps", "3", "--size", "32",
            "--hold-out-cameras", "1", *start]  # fmt: skip


def test_the_command_leaves_a_person_and_says_how_good_it_is(line, tmp_path, capsys):
    cli.main(line)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "depth.png", "front.png", "person.human.safetensors", "side.png"
    ]  # fmt: skip
    human = load_human(tmp_path / "out" / "person.human.safetensors")
    assert human.provenance["refined_from"] == "person_000001"
    assert (human.provenance["refined_views"], human.provenance["refined_steps"]) == (6, 3)
    printed = capsys.readouterr().out.splitlines()
    assert "2 frames, 3 cameras, 3 steps" in printed[0]
    before, after = (float(word) for word in printed[2].split()[2:5:2])
    assert printed[2].endswith("(cameras 2)")
    assert after > before


def test_a_cancelled_command_leaves_nothing(line, tmp_path, fails, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("primdiffusion.commands.reconstruct.refine", interrupted)
    assert fails(*line).code == cli.INTERRUPTED
    assert not (tmp_path / "out").exists()
    assert not list(tmp_path.rglob(".*.partial"))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (("--subject", "nobody"), "no subject 'nobody'"),
        (("--start", "missing.human"), "missing.human"),
        (("--hold-out-cameras", "4"), "cannot be held out"),
        (("--size", "0"), "size is 0"),
    ],
)
def test_the_command_rejects_in_one_sentence(line, tmp_path, fails, change, sentence):
    failed = fails(*line, *change)
    assert (failed.code, failed.err.count("\n")) == (1, 1)
    assert sentence in failed.err
    assert not (tmp_path / "out").exists()


def striped_body() -> TexturedMesh:
    """The bare body, rings of colours around all limbs: no asset is needed."""
    stripes = np.zeros((64, 64, 4), np.uint8)
    stripes[..., 3] = 255
    stripes[..., 0] = np.where(np.arange(64) // 4 % 2, 220, 40)[None]
    stripes[..., 1] = np.where(np.arange(64) // 4 % 2, 200, 60)[:, None]
    stripes[..., 2] = 90
    return body_mesh(stripes)


@pytest.mark.slow
def test_a_bare_body_takes_on_the_captured_one_s_colours(tmp_path):
    """From grey to 33 dB on cameras that were held out, and to 31 dB in a pose that was."""
    people = {"striped": save_person(tmp_path / "people" / "striped.glb", striped_body())}
    poses, rig = built_in_poses().map(lambda t: t[:5]), Rig(count=12, width=160, height=160)
    job = RenderJob(people, poses, tmp_path / "out", rig, ("img", "mask"))
    assert {outcome.status for outcome in render(job)} == {"done"}
    captures = open_captures(job.out)
    held, given = split_cameras(12, 3)
    shown = [conditioning_views(captures, "striped", frame, given) for frame in range(4)]
    start = bare_body(torch.zeros(10))
    refined = refine(start, shown, DescentSettings(steps=150)).human
    for frames, cameras, least in ((range(4), held, 33.0), ((4,), range(12), 31.0)):
        judged = [conditioning_views(captures, "striped", frame, cameras) for frame in frames]
        reached = float(view_psnr(refined, judged).mean())
        assert reached > least
        assert reached > float(view_psnr(start, judged).mean()) + 5


def test_adam_is_that_of_torch():
    values = torch.randn(2, 5, generator=torch.Generator().manual_seed(0))
    own, theirs = ([value.clone().requires_grad_() for value in values] for _ in range(2))
    adam, torchs = Adam.of(own, (0.7, 0.9)), torch.optim.Adam(theirs, betas=(0.7, 0.9))
    for rate in (0.3, 0.2, 0.1):
        torchs.param_groups[0]["lr"] = rate
        torchs.zero_grad()
        torch.stack(theirs).pow(4).sum().backward()
        torchs.step()
        adam.step(torch.autograd.grad(torch.stack(own).pow(4).sum(), own), rate)
    assert torch.allclose(torch.stack(own), torch.stack(theirs), atol=1e-6)
    assert (torch.stack(own) - values).abs().min() > 0.1


def test_a_fit_loads_neither_the_compiler_of_torch_nor_trimesh():
    """They take 190 MB, a sixth of what a human from a picture takes."""
    code = """
import sys, torch
from primdiffusion.commands import reconstruct
from primdiffusion.render.descent import Adam
value = torch.zeros(1, requires_grad=True)
Adam.of([value], (0.7, 0.9)).step(torch.autograd.grad(value.sum(), [value]), 0.1)
print({"torch._dynamo", "trimesh", "networkx"} & set(sys.modules))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
