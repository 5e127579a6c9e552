"""Files that the extension reads in Blender; see `targets`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from fuzz import mutations
from fuzz.data_targets import NPY, as_json, as_npy
from fuzz.target import Target, finite, finite_members


def make_human(folder: Path, motion: bool = False, compact: bool = False) -> Path:
    from primdiffusion.human import generate
    from primdiffusion.human_file import save_human
    from tiny_model import tiny_model

    from blender_primdiffusion.scene.human_file import HumanMotion, read_tensors, with_motion, write_tensors

    path = folder / "a.human"
    save_human(path, generate(tiny_model(), seed=3, steps=2), compact=compact)
    if motion:
        turns = np.broadcast_to(np.eye(3, dtype=np.float32), (3, 24, 3, 3))
        moving = HumanMotion(np.arange(3, dtype=np.float32), turns, np.zeros((3, 3), np.float32), 30.0)
        write_tensors(path, with_motion(read_tensors(path), moving))
    return path


def make_moving(folder: Path) -> Path:
    return make_human(folder, motion=True)


def make_compact(folder: Path) -> Path:
    return make_human(folder, compact=True)


def read_human(path: Path) -> None:
    """What Import Human File, the engine and a drop from the file browser do with it."""
    from blender_primdiffusion.scene.human_file import motion_in, read_tensors
    from blender_primdiffusion.scene.rest_human import read_human

    motion = motion_in(read_tensors(path), path.name)
    if motion is not None:
        finite_members(motion)
    human = read_human(path)
    finite_members(human.payload, human.rest, human.grids())


def make_checkpoint(folder: Path) -> Path:
    from tiny_model import save_tiny_checkpoint

    return save_tiny_checkpoint(folder / "model.safetensors")


def read_vocabulary(path: Path) -> None:
    from blender_primdiffusion.ui.attributes import read_vocabulary

    finite(*read_vocabulary(path).scalars.values())


def make_small(folder: Path) -> Path:
    """On a body of the user's files, of which Blender reads the file beside it."""
    import synthetic

    return synthetic.write(folder, count=6)


def make_body_file(folder: Path) -> Path:
    return make_small(folder).with_name("body.safetensors")


def read_body_file(path: Path) -> None:
    from blender_primdiffusion.scene.human_file import file_version
    from blender_primdiffusion.scene.rest_human import _read_body

    _read_body.cache_clear()
    finite_members(_read_body(file_version(path)))


def make_proxy(folder: Path) -> Path:
    import exporting

    exporting.write_store(folder)
    return folder / "proxy.npz"


def read_proxy(path: Path) -> None:
    from blender_primdiffusion.scene.proxy import read_proxy

    finite_members(read_proxy(path))


def read_motion(path: Path) -> None:
    """As Import Motion does, and its file browser before."""
    from blender_primdiffusion.formats.poses.files import read_motion

    from blender_primdiffusion.ui.import_motion import look_at

    look_at(str(path))
    finite_members(read_motion(path))


def make_bones(folder: Path) -> Path:
    from fuzz.targets import make_bvh

    return make_bvh(folder)


def make_cameras(folder: Path) -> Path:
    one = {"K": [[50, 0, 16], [0, 50, 16], [0, 0, 1]], "R": np.eye(3).tolist(), "T": [0, 0, 3]}
    (folder / "cameras.json").write_text(json.dumps({"camera0000": one, "camera0001": one}), encoding="utf-8")
    return folder / "cameras.json"


def read_cameras(path: Path) -> None:
    from blender_primdiffusion.capture.command import read_cameras

    finite_members(*read_cameras(path, 32, 32))


def make_body(folder: Path) -> Path:
    from blender_primdiffusion.formats.arrays import read_arrays
    from blender_primdiffusion.formats.body_layout import body_data

    names = ("v_template", "shapedirs", "posedirs", "J_regressor", "weights", "f", "kintree_table")
    np.savez(folder / "body.npz", **read_arrays(body_data("body.npz"), names))
    return folder / "body.npz"


def read_body(path: Path) -> None:
    from blender_primdiffusion.capture.body import read_body

    finite_members(read_body(path))


def make_parameters(folder: Path) -> Path:
    (folder / "scan.obj").write_text("v 0 0 0", encoding="utf-8")
    turns = np.random.default_rng(0).normal(0, 0.3, (1, 72))
    np.savez(
        folder / "scan.npz", global_orient=turns[:, :3], body_pose=turns[:, 3:], betas=np.zeros((1, 10)),
        transl=np.zeros((1, 3)), scale=np.ones(1),
    )  # fmt: skip
    return folder / "scan.npz"


def read_parameters(path: Path) -> None:
    from blender_primdiffusion.capture.scan_files import find_scans, read_parameters

    (scan,) = find_scans(path.with_suffix(".obj"))
    finite_members(read_parameters(scan))


def make_scan(folder: Path) -> Path:
    from capture_scenes import save_person

    return save_person(folder / "scan.glb")


def read_scan_shape(path: Path) -> None:
    from blender_primdiffusion.capture.scan_files import own_betas

    found = own_betas(path)
    if found is not None:
        finite(found[0])


TARGETS = (
    Target("human in Blender", make_human, mutations.SAFETENSORS, read_human),
    Target("moving human in Blender", make_moving, mutations.SAFETENSORS, read_human),
    Target("compact human in Blender", make_compact, mutations.SAFETENSORS, read_human),
    Target("vocabulary", make_checkpoint, mutations.SAFETENSORS, read_vocabulary),
    Target("small human in Blender", make_small, mutations.SAFETENSORS, read_human),
    Target("body file", make_body_file, mutations.SAFETENSORS, read_body_file),
    Target("proxy", make_proxy, mutations.NPZ, read_proxy),
    Target("motion .npy", as_npy, NPY, read_motion),
    Target("motion .json", as_json, mutations.JSON, read_motion),
    Target("motion .bvh", make_bones, mutations.TEXT, read_motion),
    Target("cameras", make_cameras, mutations.JSON, read_cameras),
    Target("body of captures", make_body, mutations.NPZ, read_body),
    Target("parameters of a scan", make_parameters, mutations.NPZ, read_parameters),
    Target("shape of a scan", make_scan, mutations.PLAIN, read_scan_shape),
)
