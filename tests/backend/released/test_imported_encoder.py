"""The encoder imported from a released file of 475 tensors: what it is made of, and its use on captures."""

import json
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch
from PIL import Image
from primdiffusion import cli
from primdiffusion.body.smpl_files import load_body
from primdiffusion.capture.conditioning import captured_person
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.encoder.config import RELEASED
from primdiffusion.encoder.model import load_encoder, unproject_views
from primdiffusion.files import tensor_file
from primdiffusion.formats.capture_layout import picture_path
from primdiffusion.geometry.camera import look_at
from primdiffusion.human import place
from primdiffusion.human_file import load_human
from primdiffusion.people.stored_people import read_payloads
from primdiffusion.primitives.primitives import K, S
from primdiffusion.raster.z_buffer import nearest_triangles
from primdiffusion.released.imported import Reference, reference_extents
from primdiffusion.released.stage_one import account_stage_one, encoder_tensors
from released_files import (
    SMALL,
    body_arrays,
    random_network,
    random_stage_one,
    save_body,
    save_released,
    state,
    template,
)
from stage_one_twin import StageOneTwin
from support.errors import refused


def line(folder: Path, out: str = "imported.safetensors", *more: str) -> list[str]:
    return [
        "import-released", str(folder / "primdiffusion.pt"), "--smpl", str(folder / "SMPL_NEUTRAL.pkl"),
        "--uv", str(folder / "smpl_uv.obj"), "--out", str(folder / out), *more,
    ]  # fmt: skip


@pytest.fixture(scope="module")
def stage() -> dict[str, torch.Tensor]:
    return random_stage_one(template())


def save_capture(root: Path, name: str = "someone", size: int = 48, cameras: int = 4) -> Path:
    """A dataset of the drum in the released layout, grey by its normals, in two frames; returns its subject."""
    body, folder = load_body(root / "SMPL_NEUTRAL.pkl", root / "smpl_uv.obj"), root / "captures" / name
    (folder / "outputs_re_fitting").mkdir(parents=True)
    (folder.parent / "release_human_list.txt").write_text(f"{name}\n")
    corners = body.template[body.faces].double().numpy()
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    grey = np.clip(128 + 100 * normals @ [0.6, 0.0, 0.8] / np.linalg.norm(normals, axis=1), 0, 255).astype(np.uint8)
    rig = {}
    for number in range(cameras):
        yaw = 2 * np.pi * number / cameras
        position = torch.tensor([3 * np.sin(yaw), 0.2, 3 * np.cos(yaw)]).float()
        camera = look_at(position, torch.zeros(3), vertical_fov=0.8, width=size, height=size)
        world = camera.world_to_camera.double().numpy()
        rig[f"camera{number:04d}"] = {
            "K": camera.intrinsics.double().tolist(), "R": world[:, :3].tolist(), "T": world[:, 3].tolist()
        }  # fmt: skip
        found = nearest_triangles(corners, camera).triangle
        mask = np.where(found >= 0, 255, 0).astype(np.uint8)
        for kind, pixels in (("img", np.where(found >= 0, grey[found], 0)[..., None].repeat(3, -1)), ("mask", mask)):
            for frame in range(2):
                path = picture_path(folder, kind, number, frame)
                path.parent.mkdir(parents=True, exist_ok=True)
                Image.fromarray(pixels.astype(np.uint8)).save(path)
    (folder / "cameras.json").write_text(json.dumps(rig))
    parameters = {
        "global_orient": np.zeros((2, 3)), "body_pose": np.zeros((2, 69)), "betas": np.zeros((1, 10)),
        "transl": np.zeros((2, 3)),
    }  # fmt: skip
    np.savez(folder / "outputs_re_fitting" / "refit_smpl_2nd.npz", smpl=np.array(parameters, dtype=object))
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory, stage) -> Path:
    """SMPL, the authors' file and what it is imported to, and captures on that body."""
    folder = tmp_path_factory.mktemp("stage_one")
    save_body(folder)
    save_released(folder / "primdiffusion.pt", state(random_network(SMALL).state_dict(), template(), stage))
    save_capture(folder)
    cli.run(line(folder, "imported.safetensors"))
    return folder


@pytest.fixture(scope="module")
def encoder_file(folder) -> Path:
    return folder / "imported.encoder.safetensors"


def test_the_file_holds_the_weights_as_they_were_and_nothing_of_smpl(folder, encoder_file, stage):
    model = load_encoder(encoder_file)
    assert model.config == RELEASED
    for name, value in encoder_tensors(stage).items():
        torch.testing.assert_close(model.encoder.state_dict()[name], value, rtol=0, atol=0, msg=name)
    assert model.card["parameters"] == 7_190_747
    body = load_body(folder / "SMPL_NEUTRAL.pkl", uv=folder / "smpl_uv.obj")
    torch.testing.assert_close(model.body.template, body.template)
    denoiser = load_checkpoint(folder / "imported.safetensors")
    extents = model.body_setup.anchors.rest_half_extent
    torch.testing.assert_close(extents, denoiser.body_setup.anchors.rest_half_extent)
    torch.testing.assert_close(extents, reference_extents(model.body_setup, Reference.template()))
    with safetensors.safe_open(encoder_file, framework="pt") as file:
        shapes = {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}  # noqa: SIM118
        metadata = json.dumps(file.metadata())
    vertices, faces = len(body_arrays()["v_template"]), len(body_arrays()["f"])
    assert not any(vertices in shape or faces in shape for shape in shapes.values())
    assert "v_template" not in metadata


def test_reconstruct_makes_the_human_that_the_twin_makes_of_the_texture(folder, encoder_file, stage):
    out = folder / "person"
    cli.run(["reconstruct", "--checkpoint", str(encoder_file), "--capture", str(folder / "captures"),
             "--out", str(out), "--size", "32"])  # fmt: skip
    human = load_human(out / "person.human.safetensors")
    model = load_encoder(encoder_file)
    person = captured_person(folder / "captures", body=model.body)
    assert person.warnings == ()
    texture = unproject_views(model.config, person.views, person.betas, model.body_setup).rgb[0]
    assert texture.max() > 100
    slabs = StageOneTwin(stage)(texture, torch.zeros(72))
    torch.testing.assert_close(human.payload.delta_scale.double(), 1 / slabs.delta_s, rtol=1e-4, atol=0)
    torch.testing.assert_close(
        human.payload.density.double(), slabs.density.flip(-2) * 0.1, rtol=0, atol=0.11
    )  # files hold densities in 255 levels
    torch.testing.assert_close(
        place(human).half_extent, model.place(human.payload, human.betas, person.views.pose).half_extent
    )
    assert human.body_setup.files == model.body_setup.files
    tensors, _ = tensor_file.read(out / "body.safetensors")
    np.testing.assert_allclose(tensors["template"], body_arrays()["v_template"], atol=1e-6)


def test_payloads_are_encoded_with_it(folder, encoder_file):
    out = folder / "payloads"
    cli.run(["payloads", "encode", "--captures", str(folder / "captures"), "--encoder", str(encoder_file),
             "--out", str(out), "--views", "2", "--looks", "2"])  # fmt: skip
    stored = read_payloads(out / "someone.npz")
    assert stored.voxels.shape == (2, K, S, S, S, 4)
    model = load_encoder(encoder_file)
    person = captured_person(folder / "captures", views=2, body=model.body)
    wanted = model.encode(person.views, person.betas)
    torch.testing.assert_close(stored.payload(0).delta_scale, wanted.delta_scale, rtol=1e-3, atol=0)


def test_captures_on_the_default_body_are_rejected(folder, encoder_file, tmp_path):
    model = load_encoder(encoder_file)
    subject = folder / "captures" / "someone"
    other = tmp_path / "someone"
    other.mkdir()
    for part in subject.iterdir():
        (other / part.name).symlink_to(part)
    joints = np.zeros((2, 24, 3))
    joints[:, :, 1] = 1
    np.savez(other / "joints.npz", world=joints)
    with refused(ValueError, "SMPL"):
        captured_person(other, body=model.body)


@pytest.mark.parametrize("prefix", ["", "bodydecoder."])
def test_a_stage_1_file_gives_the_encoder_alone(folder, encoder_file, tmp_path, prefix, stage):
    save_body(tmp_path)
    save_released(tmp_path / "primdiffusion.pt", {f"{prefix}{name}": value for name, value in stage.items()})
    cli.run(line(tmp_path, "stage.safetensors"))
    assert sorted(path.name for path in tmp_path.glob("*.safetensors")) == ["stage.safetensors"]
    found, wanted = (safetensors.torch.load_file(path) for path in (tmp_path / "stage.safetensors", encoder_file))
    assert found.keys() == wanted.keys()
    assert all(torch.equal(found[name], wanted[name]) for name in wanted)


# Names within the groups are only partly known.


def renamed(tensors: dict[str, torch.Tensor], names: dict[str, str]) -> dict[str, torch.Tensor]:
    def new(key: str) -> str:
        module, _, kind = key.rpartition(".")
        return f"{names.get(module, module)}.{kind}"

    return {new(key): value for key, value in tensors.items()}


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def test_layers_are_recognised_by_shape_and_natural_order_whatever_their_names_and_order(stage):
    other = renamed(stage, {
        "decoder_motion.0": "decoder_motion.net.2", "decoder_motion.3": "decoder_motion.net.10",
        "decoder_rgb.0": "decoder_rgb.z", "embs_encoder.out": "embs_encoder.a.b.c",
    })  # fmt: skip
    shuffled = {name: other[name] for name in sorted(other, reverse=True)}
    assert len(account_stage_one(shuffled, "")) == 165
    assert same(encoder_tensors(shuffled), encoder_tensors(stage))


def test_layers_that_nothing_tells_apart_are_refused(stage):
    other = renamed(stage, {"decoder_motion.0": "decoder_motion.enter", "decoder_motion.3": "decoder_motion.leave"})
    with refused(ValueError, "decoder_motion.enter", "decoder_motion.leave"):
        account_stage_one(other, "")


def test_both_stages_cannot_be_written_to_one_file(folder, capsys):
    with refused(ValueError, "--encoder"):
        cli.run(line(folder, "both.safetensors", "--encoder", str(folder / "both.safetensors")))
    assert not (folder / "both.safetensors").exists()
