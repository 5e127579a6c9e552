"""Every kind of file and message that the programs read: a valid one, how it is damaged, how it is read."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from fuzz import data_targets, extension_targets, mutations, other_files, reader_targets, served
from fuzz.target import Garbage, Target, finite, finite_members

# --- humans and models


def read_human(path: Path) -> None:
    from primdiffusion.human_file import load_human

    human = load_human(path)
    finite(human.payload.rgb, human.payload.density, human.payload.delta_scale, human.betas)
    if (human.payload.density < 0).any():
        raise Garbage("density below zero")


def make_checkpoint(folder: Path) -> Path:
    from primdiffusion.diffusion.checkpoint import save_checkpoint
    from tiny_model import tiny_model

    save_checkpoint(folder / "model.safetensors", tiny_model(), "linear")
    return folder / "model.safetensors"


def read_checkpoint(path: Path) -> None:
    from primdiffusion.diffusion.checkpoint import load_checkpoint
    from primdiffusion.diffusion.model_card import model_card
    from primdiffusion.human import generate

    model = load_checkpoint(path)
    finite(*model.denoiser.state_dict().values(), model.full_density)
    if not model.full_density > 0:
        raise Garbage(f"full density {model.full_density}")
    model_card({"held_out_rms_x0_error": {"x": {"0": 1.0}}, **model.card})
    try:
        generate(model, 1, 1)
    except ValueError as error:  # weights of any size may be read
        if "NaN" not in str(error):
            raise


def make_released(folder: Path) -> Path:
    from released_files import TINY, random_network, state, template

    tensors = state(dict(random_network(TINY).state_dict()), template())
    small = {
        name: value if value.numel() < 9999 else value.new_zeros(()).expand(value.shape)
        for name, value in tensors.items()
    }
    torch.save({"model_state_dict": small, "optimizer": {"state": {}}}, folder / "released.pt")
    return folder / "released.pt"


def read_released(path: Path) -> None:
    from primdiffusion.commands.import_released import read_released

    read_released(path)


# --- bodies, poses, motions


def make_smpl_npz(folder: Path) -> Path:
    from released_files import body_arrays

    arrays = body_arrays()
    arrays["J_regressor"] = arrays["J_regressor"].toarray()  # pyright: ignore[reportAttributeAccessIssue]
    np.savez(folder / "body.npz", **arrays)  # pyright: ignore[reportArgumentType]
    return folder / "body.npz"


def make_smpl_pickle(folder: Path) -> Path:
    from released_files import save_body

    return save_body(folder)[0]


def make_uv(folder: Path) -> Path:
    from released_files import save_body

    return save_body(folder)[1]


def read_body(path: Path) -> None:
    from primdiffusion.body.model import BodyPose
    from primdiffusion.body.smpl_files import load_body

    body = load_body(path)
    finite(body.template, body.skin_weights, body.shape_basis, body.joint_regressor)
    finite(body.shape(torch.zeros(1)).pose(BodyPose.from_axis_angle(torch.zeros(72))).vertices)


def read_uv(path: Path) -> None:
    from primdiffusion.body.smpl_files import load_body

    finite(load_body(path.with_name("SMPL_NEUTRAL.pkl"), uv=path).uv)


HOSTILE = (
    b"cos\nsystem\n(S'touch CANARY'\ntR.", b"cposix\nsystem\n(S'touch CANARY'\ntR.", b"Np300000000\n.",
    b"\x80\x04\x94.", b"(" * 100_000 + b".", b"cbuiltins\neval\n(S'1'\ntR.", b"\x8d" + b"\xff" * 7 + b"\x00.",
    b"cnumpy\nload\n(S'x'\ntR.",
)  # fmt: skip
"""Calls, imports and endless memos."""


def opcodes(content: bytes, rng: np.random.Generator) -> bytes:
    """Opcodes of a pickle become those that call, import or remember."""
    place = int(rng.integers(len(content)))
    return content[:place] + mutations.pick(rng, HOSTILE) + (content[place:] if rng.random() < 0.5 else b"")


def make_pose(place: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        pose = np.random.default_rng(0).normal(0, 0.3, (24, 3)).round(3).tolist()
        (folder / "pose.json").write_text(json.dumps({"pose": pose, place: [0, 0.5, 0]}))
        return folder / "pose.json"

    return make


def read_pose_file(path: Path) -> None:
    from primdiffusion.pose_file import read_pose

    pose = read_pose(path)
    finite_members(pose)


def read_own_pose(path: Path) -> None:
    from blender_primdiffusion.motion.pose_library import load_pose

    finite(*load_pose(path))


def make_bvh(folder: Path) -> Path:
    from blender_primdiffusion.formats.poses.skeleton import REST_JOINTS
    from bvh_files import motion_of, write_bvh
    from primdiffusion.formats.joints import JOINT_NAMES

    return write_bvh(folder / "a.bvh", REST_JOINTS, *motion_of(), {name: name for name in JOINT_NAMES})


def make_amass(folder: Path) -> Path:
    from amass_files import write_amass

    write_amass(folder / "a.npz", frames=4)
    return folder / "a.npz"


def read_motion_file(path: Path) -> None:
    from blender_primdiffusion.formats.poses.files import read_motion

    motion = read_motion(path)
    finite(motion.rotations, motion.translations, motion.fps)
    turns = np.einsum("...ij,...kj->...ik", motion.rotations, motion.rotations)
    if np.abs(turns - np.eye(3)).max() > 1e-3:
        raise Garbage("rotations that are none")


# --- training data, captures, meshes


def make_payload(folder: Path) -> Path:
    from diffusion_people import write_people

    write_people(folder, 1, variants=1)
    return next(folder.glob("person_*.npz"))


def read_payload(path: Path) -> None:
    from primdiffusion.training.stored_people import read_person

    person = read_person(path)
    finite(person.delta_scale, person.betas, person.full_density)


def make_glb(folder: Path) -> Path:
    from capture_scenes import save_person

    save_person(folder / "person.glb")
    return folder / "person.glb"


def glb_header(content: bytes, rng: np.random.Generator) -> bytes:
    """A value of the .glb's JSON becomes another."""
    length = int.from_bytes(content[12:16], "little")
    text = mutations.as_json(content[20 : 20 + length], rng)
    text += b" " * (-len(text) % 4)
    rest = content[20 + length :]
    size = (20 + len(text) + len(rest)).to_bytes(4, "little")
    return content[:8] + size + len(text).to_bytes(4, "little") + content[16:20] + text + rest


def glb_numbers(content: bytes, rng: np.random.Generator) -> bytes:
    """An accessor has another type, or reads its numbers from another place."""
    length = int.from_bytes(content[12:16], "little")
    tree = json.loads(content[20 : 20 + length])
    about = mutations.pick(rng, tree["accessors"])
    about["componentType"] = mutations.pick(rng, (5120, 5121, 5122, 5123, 5125, 5126))
    about["bufferView"] = int(rng.integers(len(tree["bufferViews"])))
    about["normalized"] = bool(rng.random() < 0.2)
    if rng.random() < 0.2:
        tree["nodes"] += [node for node in tree["nodes"] if "mesh" in node] * 50_000
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    rest = content[20 + length :]
    size = (20 + len(text) + len(rest)).to_bytes(4, "little")
    return content[:8] + size + len(text).to_bytes(4, "little") + content[16:20] + text + rest


def read_glb_person(path: Path) -> None:
    from primdiffusion.capture.people_files import read_person

    for part in read_person(path).mesh.parts:
        finite_members(part)
        if (part.skin_weight < 0).any() or (part.faces < 0).any() or (part.faces >= len(part.vertices)).any():
            raise Garbage("weights below zero, or faces without vertices")


def make_mhclo(folder: Path) -> Path:
    head = ["name x", "obj_file x.obj", "x_scale 1 2 0.1", "verts 0"]
    fits = [f"{n} {n + 1} {n + 2} 0.3 0.3 0.4 0 0 0.1" for n in range(9)]
    (folder / "x.mhclo").write_text("\n".join(head + fits))
    vertices, corners = [f"v {n} {n * n} 1" for n in range(9)], [f"vt 0.{n} 0.5" for n in range(9)]
    (folder / "x.obj").write_text("\n".join([*vertices, *corners, "f 1/1 2/2 3/3", "f 4/4 5/5 6/6 7/7"]))
    return folder / "x.mhclo"


def make_obj(folder: Path) -> Path:
    return make_mhclo(folder).with_suffix(".obj")


def read_proxy(path: Path) -> None:
    from primdiffusion.people.mhclo import read_pair

    proxy, mesh = read_pair(path.with_suffix(".mhclo"), path.with_suffix(".obj"))
    finite_members(proxy, mesh)


def make_picture(folder: Path) -> Path:
    from PIL import Image

    Image.fromarray(np.random.default_rng(0).integers(0, 255, (24, 24, 3), np.uint8)).save(folder / "a.png")
    return folder / "a.png"


def read_picture(path: Path) -> None:
    from primdiffusion.capture.reader import _opened, _read

    with _opened(path) as file:
        _read(file, path, "img", 24, 24)


def make_grid(folder: Path) -> Path:
    rng = np.random.default_rng(0)
    density, colour = rng.random((4, 5, 6), np.float32), rng.random((4, 5, 6, 3), np.float32)
    np.savez(folder / "grid.npz", density=density, colour=colour, origin=np.zeros(3), voxel=np.array(0.01))
    return folder / "grid.npz"


def read_merged(path: Path) -> None:
    from blender_primdiffusion.scene.merged import read_grid

    grid = read_grid(path)
    finite_members(grid)


TARGETS = (
    Target("human", extension_targets.make_human, mutations.SAFETENSORS, read_human),
    Target("compact human", extension_targets.make_compact, mutations.SAFETENSORS, read_human),
    Target("checkpoint", make_checkpoint, mutations.SAFETENSORS, read_checkpoint),
    Target("released checkpoint", make_released, mutations.TORCH, read_released),
    Target("SMPL .npz", make_smpl_npz, mutations.NPZ, read_body),
    Target("SMPL .pkl", make_smpl_pickle, (*mutations.PLAIN, opcodes, opcodes), read_body),
    Target("UV .obj", make_uv, mutations.TEXT, read_uv),
    Target("pose", make_pose("translation"), mutations.JSON, read_pose_file),
    Target("own pose", make_pose("transl"), mutations.JSON, read_own_pose),
    Target("BVH", make_bvh, mutations.TEXT, read_motion_file),
    Target("AMASS", make_amass, mutations.NPZ, read_motion_file),
    Target("payload", make_payload, mutations.NPZ, read_payload),
    Target("glb", make_glb, (*mutations.PLAIN, glb_header, glb_header, glb_header, glb_numbers), read_glb_person),
    Target("mhclo", make_mhclo, mutations.TEXT, read_proxy),
    Target("obj", make_obj, mutations.TEXT, read_proxy),
    Target("picture", make_picture, mutations.PLAIN, read_picture),
    Target("merged grid", make_grid, mutations.NPZ, read_merged),
    *data_targets.TARGETS,
    *extension_targets.TARGETS,
    *reader_targets.TARGETS,
    *served.TARGETS,
    *(one for one in other_files.TARGETS if one.mutations),
)
