"""An imported checkpoint is used like our own, on the user's SMPL body, of which no file of ours holds anything."""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import safetensors
import safetensors.torch
import torch
from primdiffusion import cli
from primdiffusion.body.smpl_files import load_body
from primdiffusion.commands.render import FrameDrawer, map_frame
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.diffusion.codec import ReleasedSlab
from primdiffusion.diffusion.schedule import released_steps
from primdiffusion.drawing import Scene, ViewSettings, draw
from primdiffusion.files import tensor_file
from primdiffusion.files.regular_files import FileError
from primdiffusion.formats.requests import DrawRequest, PosedPerson
from primdiffusion.human import framing, generate, place, place_skinned
from primdiffusion.human_file import load_human, save_human
from primdiffusion.primitives.primitives import K, Payload
from released_files import TINY, body_arrays, random_network, save_body, save_released, state, template
from support.errors import refused


def line(folder: Path, *more: str) -> list[str]:
    return [
        "import-released", str(folder / "primdiffusion.pt"), "--smpl", str(folder / "SMPL_NEUTRAL.pkl"),
        "--uv", str(folder / "smpl_uv.obj"), "--out", str(folder / "imported.safetensors"), *more,
    ]  # fmt: skip


def prepared(folder: Path) -> Path:
    """A folder with the authors' file and the user's SMPL."""
    save_body(folder)
    save_released(folder / "primdiffusion.pt", state(random_network(TINY).state_dict(), template()))
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = prepared(tmp_path_factory.mktemp("released"))
    cli.run(line(folder))
    return folder


@pytest.fixture
def copied(folder, tmp_path) -> Path:
    """The same in a folder of its own, imported there."""
    for name in ("primdiffusion.pt", "SMPL_NEUTRAL.pkl", "smpl_uv.obj"):
        shutil.copy(folder / name, tmp_path)
    cli.run(line(tmp_path))
    return tmp_path


@pytest.fixture(scope="module")
def person(folder) -> Path:
    out = folder / "person"
    checkpoint = str(folder / "imported.safetensors")
    cli.run(["generate", "--checkpoint", checkpoint, "--out", str(out), "--seed", "3", "--steps", "1", "--size", "32"])
    return out


def test_the_imported_denoiser_gives_what_the_source_weights_give(folder):
    model = load_checkpoint(folder / "imported.safetensors")
    x = torch.randn(1, 56, 32, 32, generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        expected = random_network(TINY)(x, torch.tensor([431]))
    torch.testing.assert_close(model.denoise(x, 431), expected)
    assert isinstance(model.codec, ReleasedSlab)
    assert model.chain is released_steps
    assert model.full_density == 25.5
    assert model.schedule.alpha_bar[-1].item() == pytest.approx(np.prod(1 - np.linspace(0.01, 0.02**0.5, 1000) ** 2))


def test_generate_makes_people_on_the_users_body(person, folder):
    files = sorted(path.name for path in person.iterdir())
    assert files == ["body.safetensors", "depth.png", "front.png", "person.human.safetensors", "side.png"]
    body = load_body(folder / "SMPL_NEUTRAL.pkl", uv=folder / "smpl_uv.obj")
    tensors, metadata = tensor_file.read(person / "body.safetensors")
    np.testing.assert_allclose(tensors["template"], body.template, atol=1e-6)
    np.testing.assert_array_equal(tensors["faces"], body.faces)
    assert tensors["rest_half_extent"].shape == (K, 3)
    assert metadata["format"] == "primdiffusion.body"
    assert load_human(person / "person.human.safetensors").provenance["seed"] == 3


def test_a_saved_person_comes_back_on_the_same_body(person, folder):
    human = load_human(person / "person.human.safetensors")
    again = generate(load_checkpoint(folder / "imported.safetensors"), 3, steps=1)
    first, second = place(human), place(again)
    for name, value in vars(first).items():
        torch.testing.assert_close(value, getattr(second, name), msg=name)
    rest = torch.eye(4)[:3].expand(24, 3, 4)
    skinned = place_skinned(human, rest, torch.eye(4)[:3])
    torch.testing.assert_close(skinned.position, first.position, atol=1e-5, rtol=0)
    picture = person / "again.png"
    cli.run(["render", str(person / "person.human.safetensors"), "--out", str(picture), "--size", "32"])
    assert picture.read_bytes() == (person / "front.png").read_bytes()
    picture.unlink()


def test_the_engines_frames_and_boxes_show_people_on_the_users_body(person, tmp_path):
    human = load_human(person / "person.human.safetensors")
    generator = torch.Generator().manual_seed(0)
    payload = Payload(torch.rand(K, 3, 8, 8, 8, generator=generator), torch.full((K, 8, 8, 8), 90.0), torch.ones(K, 3))
    human = dataclasses.replace(human, payload=payload)
    save_human(tmp_path / "a.human.safetensors", human)
    primitives, still = place(human), torch.eye(3, 4).tolist()
    camera = framing(primitives, 23, 40, 56)
    for view, chart in (("colour", None), ("boxes", human.body_setup.anchors.chart)):
        np.full(40 * 56 * 5, np.nan, np.float32).tofile(tmp_path / "frame")
        params = DrawRequest(
            frame=tmp_path / "frame", width=40, height=56, view=view, intrinsics=camera.intrinsics.tolist(),
            world_to_camera=camera.world_to_camera.tolist(),
            people=[PosedPerson(tmp_path / "a.human.safetensors", still, [still] * 24)],
        )  # fmt: skip
        FrameDrawer(torch.device("cpu")).draw(params, lambda *_: None)
        want = draw(Scene(primitives, chart=chart), camera, ViewSettings(view, clip=(0.0, 1e10)))
        found = map_frame(params.frame, 40, 56).rgba
        assert (want.alpha > 0.5).mean() > 0.2
        assert np.abs(found - want.rgba).mean() < 2e-3


def test_no_file_of_ours_holds_any_of_smpl(person, folder):
    """Neither places of vertices nor which of them make faces; only how boxes lie on numbered faces."""
    vertices = len(body_arrays()["v_template"])
    faces = len(body_arrays()["f"])
    for path, held in ((folder / "imported.safetensors", {"face", "barycentric", "rest_half_extent", "betas"}),
                       (person / "person.human.safetensors", {"rest_half_extent"})):  # fmt: skip
        with safetensors.safe_open(path, framework="pt") as file:
            shapes = {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}  # noqa: SIM118
            text = json.dumps(file.metadata())
        assert not any(vertices in shape or faces in shape for shape in shapes.values())
        assert held <= {name.removeprefix("stand.") for name in shapes}
        assert "SMPL_NEUTRAL.pkl" in text
        assert "v_template" not in text


def test_the_table_is_printed(tmp_path, capsys):
    cli.run(line(prepared(tmp_path)))
    out = capsys.readouterr().out.splitlines()
    assert out[0].split() == ["group", "fate", "tensors", "values", "note"]
    assert any(row.startswith("decoder_geom") and "dropped" in row for row in out)
    assert "the SMPL file is the body that the checkpoint was trained on" in out
    assert out[-2:] == [str(tmp_path / "imported.safetensors"), str(tmp_path / "imported.encoder.safetensors")]


def test_a_body_that_is_gone_changed_or_moved(copied):
    checkpoint, smpl = copied / "imported.safetensors", copied / "SMPL_NEUTRAL.pkl"
    content = smpl.read_bytes()
    smpl.unlink()
    with refused(FileError, "SMPL_NEUTRAL.pkl"):
        load_checkpoint(checkpoint)
    smpl.write_bytes(content[:-1] + b"!")
    with refused(FileError, "SMPL_NEUTRAL.pkl"):
        load_checkpoint(checkpoint)
    smpl.unlink()
    elsewhere = copied / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / smpl.name).write_bytes(content)
    shutil.copy(checkpoint, elsewhere)
    assert load_checkpoint(elsewhere / checkpoint.name).body_setup is not None


def test_a_missing_body_is_named_by_its_file(copied, person):
    saved = copied / "person.human.safetensors"
    human = load_human(person / "person.human.safetensors")
    save_human(saved, human)
    with safetensors.safe_open(saved, framework="pt") as file:
        metadata = file.metadata()
    body = json.loads(metadata["body"])
    body["smpl"]["sha256"] = "0" * 64
    tensors = safetensors.torch.load_file(saved)
    safetensors.torch.save_file(tensors, saved, {**metadata, "body": json.dumps(body)})
    with refused(FileError, "person.human"):
        load_human(saved)
    safetensors.torch.save_file(tensors, saved, {**metadata, "body": "{}"})
    with refused(FileError, "smpl"):
        load_human(saved)
    del tensors["rest_half_extent"]
    safetensors.torch.save_file(tensors, saved, metadata)
    with refused(FileError):
        load_human(saved)


def test_an_imported_file_that_contradicts_itself_is_rejected(copied):
    path = copied / "imported.safetensors"
    with safetensors.safe_open(path, framework="pt") as file:
        metadata = file.metadata()
    tensors = safetensors.torch.load_file(path)
    moved = {**tensors, "stand.face": tensors["stand.face"].flip(0).contiguous()}
    safetensors.torch.save_file(moved, path, metadata)
    with refused(FileError, "anchors"):
        load_checkpoint(path)
    safetensors.torch.save_file({**tensors, "stand.betas": torch.zeros(9)}, path, metadata)
    with refused(FileError, "imported.safetensors", "(9,)"):
        load_checkpoint(path)
    del tensors["denoiser.time_embed.0.bias"]
    safetensors.torch.save_file(tensors, path, metadata)
    with refused(FileError, "time_embed.0.bias"):
        load_checkpoint(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("truncated", "truncated"),
        ("no smpl", "SMPL_NEUTRAL.pkl; give the path of an SMPL .pkl or .npz file"),
        ("another smpl", "SMPL_NEUTRAL.pkl"),
        ("another uv", "smpl_uv.obj"),
        ("no uv", "smpl_uv.obj: no such file"),
        ("unknown tensor", "'diffusion.label_emb.weight'"),
    ],
)
def test_what_cannot_be_imported_is_rejected_in_a_sentence_and_nothing_written(tmp_path, fails, change, message):
    prepared(tmp_path)
    weights, smpl, uv = (tmp_path / name for name in ("primdiffusion.pt", "SMPL_NEUTRAL.pkl", "smpl_uv.obj"))
    if change == "truncated":
        weights.write_bytes(weights.read_bytes()[:-500])
    elif change == "unknown tensor":
        tensors = torch.load(weights, weights_only=True)["model_state_dict"]
        save_released(weights, {**tensors, "diffusion.label_emb.weight": torch.zeros(3, 4)})
    elif change.startswith("another"):
        (smpl if "smpl" in change else uv).write_bytes(b"hello")
    else:
        (smpl if "smpl" in change else uv).unlink()
    failed = fails(*line(tmp_path))
    assert (failed.code, failed.err.count("\n")) == (1, 1)
    assert message in failed.err
    assert not (tmp_path / "imported.safetensors").exists()


def test_the_reference_subject_sets_sizes_and_shape(folder, tmp_path):
    subject = tmp_path / "seq_000016-rp_alison_rigged_002"
    (subject / "outputs_re_fitting").mkdir(parents=True)
    betas = np.zeros((1, 10), np.float32)
    betas[0, 0] = -9
    parameters = {
        "global_orient": np.zeros((2, 3)), "body_pose": np.zeros((2, 69)), "betas": betas, "transl": np.ones((2, 3)),
    }  # fmt: skip
    np.savez(subject / "outputs_re_fitting" / "refit_smpl_2nd.npz", smpl=np.array(parameters, dtype=object))
    arguments = line(folder, "--reference", str(subject))
    out = tmp_path / "imported.safetensors"
    arguments[arguments.index(str(folder / "imported.safetensors"))] = str(out)
    cli.run(arguments)
    model, plain = load_checkpoint(out), load_checkpoint(folder / "imported.safetensors")
    assert (model.body_setup.anchors.rest_half_extent < 0.7 * plain.body_setup.anchors.rest_half_extent).any()
    shapes = model.betas(torch.zeros(2, 1, 1, 1), [1, 2])
    assert shapes.tolist() == [[-5.0] + [0.0] * 9] * 2, "betas beyond what people files hold are limited"
    assert plain.betas(torch.zeros(1, 1, 1, 1), [1]).abs().max() == 0
