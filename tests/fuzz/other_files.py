"""Files that the programs read beside those in `targets`: what they have written themselves, and what Blender reads."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from fuzz import mutations
from fuzz.mutations import Mutation
from fuzz.target import Garbage, Target, finite, finite_members

_DATASET: dict[str, Path] = {}


def of_captures(pattern: str) -> Callable[[Path], Path]:
    """A file of a dataset of captures, which is rendered once."""

    def make(folder: Path) -> Path:
        from capture_scenes import captured

        if "root" not in _DATASET or not _DATASET["root"].is_dir():
            _DATASET["root"] = captured(folder / "rendered", people=1, frames=1)
        shutil.copytree(_DATASET["root"], folder / "captures")
        return next((folder / "captures").rglob(pattern))

    return make


def _root(path: Path) -> Path:
    return next(parent for parent in path.parents if parent.name == "captures")


def read_view(path: Path) -> None:
    from primdiffusion.capture.reader import open_captures

    captures = open_captures(_root(path))
    view = captures.view(captures.subjects[0], 0, 0)
    finite_members(view)


def read_joints(path: Path) -> None:
    from primdiffusion.capture.coco import keypoints_of
    from primdiffusion.capture.reader import open_captures
    from primdiffusion.capture.sheet import reprojection_error

    captures = open_captures(_root(path))
    subject = captures.subject(captures.subjects[0])
    keypoints_of(subject)
    reprojection_error(subject)


def read_parameters(path: Path) -> None:
    from primdiffusion.capture.smpl_parameters import read_smpl

    finite(read_smpl(path.parents[1]).pose(0).translation)


def without_plain(make: Callable[[Path], Path]) -> Callable[[Path], Path]:
    """The pickled form of poses, alone as in the released dataset."""

    def pickled(folder: Path) -> Path:
        from primdiffusion.formats.capture_layout import SMPL_PLAIN_FILE

        path = make(folder)
        path.with_name(SMPL_PLAIN_FILE).unlink()
        return path

    return pickled


def check_captures(path: Path) -> None:
    from primdiffusion.formats.capture_repair import verify

    if not verify(_root(path)) and not path.is_file():
        raise Garbage("nothing is wrong")


def make_pack(ending: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        from primdiffusion.capture.dataset import pack_subject
        from primdiffusion.capture.reader import open_captures

        of_captures("dataset.json")(folder)
        captures = open_captures(folder / "captures")
        pack_subject(captures.subject(captures.subjects[0]))
        return next((folder / "captures").rglob(f"{captures.subjects[0]}{ending}"))

    return make


def read_pack(path: Path) -> None:
    from primdiffusion.capture.dataset import open_pack
    from primdiffusion.capture.reader import open_captures

    captures = open_captures(_root(path))
    if open_pack(captures.subject(captures.subjects[0])) is not None and not path.is_file():
        raise Garbage("a pack that is not there")


def make_hub(name: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        from tiny_model import save_tiny_checkpoint

        commit = "0" * 40
        (folder / "hub" / "snapshots" / commit).mkdir(parents=True)
        (folder / "hub" / "refs").mkdir()
        (folder / "hub" / "refs" / "main").write_text(commit, encoding="utf-8")
        save_tiny_checkpoint(folder / "hub" / "snapshots" / commit / "model.safetensors")
        return folder / "hub" / name

    return make


def read_hub(path: Path) -> None:
    from primdiffusion.diffusion.checkpoint import load_checkpoint

    load_checkpoint(next(parent for parent in path.parents if parent.name == "hub"))


def make_run(name: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        begin_run(folder / name)
        (folder / "metrics.jsonl").write_text('{"step": 0}\n', encoding="utf-8")
        return folder / name

    return make


def begin_run(path: Path) -> None:
    from primdiffusion.training.config import TrainingConfig
    from primdiffusion.training.run_folder import begin

    begin(TrainingConfig(data=path.parent, run=path.parent), ["a", "b"], {}, ["person"], 1)


def make_prepared(folder: Path) -> Path:
    (folder / "prepared.safetensors").write_bytes(b"")
    return folder / "prepared.safetensors"


def read_prepared(path: Path) -> None:
    from primdiffusion.training.cells import _load_prepared

    _load_prepared(path)


def make_lock(folder: Path) -> Path:
    (folder / "requirements.txt").write_text(f"torch==2.9 --hash=sha256:{'0' * 64}\n", encoding="utf-8")
    return folder / "requirements.txt"


def read_lock(path: Path) -> None:
    from blender_primdiffusion.backend.packages import read_lock

    read_lock(path)


def make_exr(folder: Path) -> Path:
    (folder / "a.exr").write_bytes(b"v/1\x01" + bytes(64))
    return folder / "a.exr"


def read_exr(path: Path) -> None:
    from blender_primdiffusion.capture.passes import read_exr

    read_exr(path)


def make_onnx(folder: Path) -> Path:
    (folder / "pose.onnx").write_bytes(b"x")
    return folder / "pose.onnx"


def read_onnx(path: Path) -> None:
    from primdiffusion.evaluation.onnx_networks import open_onnx

    open_onnx(path, (64, 64))


def make_frame(folder: Path) -> Path:
    np.zeros(4 * 4 * 5, np.float32).tofile(folder / "a.frame")
    return folder / "a.frame"


def map_frame(path: Path) -> None:
    from primdiffusion.commands.frame_drawer import map_frame

    map_frame(path, 4, 4)


def make_asset_picture(folder: Path) -> Path:
    from PIL import Image

    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(folder / "skin.png")
    return folder / "skin.png"


def read_asset_picture(path: Path) -> None:
    from primdiffusion.people.assets import _decoded

    _decoded.cache_clear()
    _decoded(path, 4)


def make_material(folder: Path) -> Path:
    (folder / "hair.mhmat").write_text("# license CC0\n", encoding="utf-8")
    return folder / "hair.mhmat"


def read_material(path: Path) -> None:
    from primdiffusion.people.assets import _head

    _head.cache_clear()
    if not path.is_file() and _head(path):
        raise Garbage("the head of what is no file")


# --- what Blender's own readers read


def read_preview(path: Path) -> None:
    from blender_primdiffusion.jobs.assets import picture_of_file

    picture_of_file(path)


def read_hdri(path: Path) -> None:
    import bpy

    from blender_primdiffusion.capture.settings import CaptureSettings
    from blender_primdiffusion.capture.stage import _light

    scene = bpy.data.scenes.new("Light")
    try:
        _light(scene, CaptureSettings(path.parent, light="hdri", hdri=path))
    finally:
        bpy.data.scenes.remove(scene)


def make_photograph(folder: Path) -> Path:
    from PIL import Image

    pixels = np.zeros((96, 64, 4), np.uint8)
    pixels[8:88, 24:40] = 200
    Image.fromarray(pixels).save(folder / "anna.png")
    return folder / "anna.png"


def read_photograph(path: Path) -> None:
    from primdiffusion.capture.photograph import read_photographs

    read_photographs([path])


def read_behind(path: Path) -> None:
    from primdiffusion.capture.composed import read_background

    read_background(path, 32, 48)


def place_photograph(path: Path) -> None:
    import bpy

    from blender_primdiffusion.capture.cameras import add_picture_camera

    add_picture_camera(bpy.context, path, np.zeros(3))


CAMERA = {"K": [[60.0, 0, 32], [0, 60.0, 48], [0, 0, 1]], "R": np.diag([1.0, -1, -1]).tolist(), "T": [0.0, 0, 3]}


def make_posture(folder: Path) -> Path:
    content = {"format": "primdiffusion-posture", "pose": [[0.1] * 72], "translation": [[0.0] * 3], "betas": [0.5] * 10}
    (folder / "posture.json").write_text(json.dumps({**content, "cameras": {"camera0000": CAMERA}}), encoding="utf-8")
    return folder / "posture.json"


def read_posture(path: Path) -> None:
    from primdiffusion.posture.file import read_posture

    read_posture(path, [(64, 96)])


def make_scan_picture(folder: Path) -> Path:
    from PIL import Image

    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(folder / "scan_dif.png")
    return folder / "scan_dif.png"


def find_scan_picture(path: Path) -> None:
    from blender_primdiffusion.capture.surfaces import choose_picture, pictures_beside

    found = choose_picture(path.with_name("scan.obj"), list(pictures_beside(path.with_name("scan.obj"))))
    if (found is not None) != path.is_file():
        raise Garbage("a picture that is none")


def make_mesh(folder: Path) -> Path:
    (folder / "scan.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", encoding="utf-8")
    return folder / "scan.obj"


def import_scan(path: Path) -> None:
    from blender_primdiffusion.capture.scan_files import import_file

    import_file(path)


DAMAGED: dict[str, Sequence[Mutation]] = {
    "captures: settings": mutations.JSON, "captures: cameras": mutations.JSON,
    "captures: completion mark": mutations.JSON, "captures: poses": mutations.NPZ,
}  # fmt: skip
"""Of these, others make inputs of fuzzing too."""
TARGETS = tuple(
    Target(name, make, DAMAGED.get(name, ()), read)
    for name, make, read in (
        ("captures: settings", of_captures("dataset.json"), read_view),
        ("captures: list", of_captures("release_human_list.txt"), read_view),
        ("captures: cameras", of_captures("cameras.json"), read_view),
        ("captures: picture", of_captures("img/camera0003/*.jpg"), read_view),
        ("captures: first picture", of_captures("img/camera0000/*.jpg"), read_view),
        ("captures: joints", of_captures("joints.npz"), read_joints),
        ("captures: poses", of_captures("refit_smpl_2nd_plain.npz"), read_parameters),
        ("captures: pickled poses", without_plain(of_captures("refit_smpl_2nd.npz")), read_parameters),
        ("captures: completion mark", of_captures("complete.json"), check_captures),
        ("captures: pack", make_pack(".npy"), read_pack),
        ("captures: about a pack", make_pack(".json"), read_pack),
        ("hub: commit", make_hub("refs/main"), read_hub),
        ("hub: weights", make_hub(f"snapshots/{'0' * 40}/model.safetensors"), read_hub),
        ("run: settings", make_run("config.json"), begin_run),
        ("run: starts", make_run("run.json"), begin_run),
        ("run: metrics", make_run("metrics.jsonl"), begin_run),
        ("run: latents", make_prepared, read_prepared),
        ("lock of packages", make_lock, read_lock),
        ("picture of Cycles", make_exr, read_exr),
        ("ONNX network", make_onnx, read_onnx),
        ("frame", make_frame, map_frame),
        ("texture of an asset", make_asset_picture, read_asset_picture),
        ("material of an asset", make_material, read_material),
        ("Blender: preview", make_asset_picture, read_preview),
        ("Blender: HDRI", make_asset_picture, read_hdri),
        ("Blender: plain picture", make_photograph, place_photograph),
        ("plain picture", make_photograph, read_photograph),
        ("background of captures", make_photograph, read_behind),
        ("posture", make_posture, read_posture),
        ("Blender: picture of a scan", make_scan_picture, find_scan_picture),
        ("Blender: scan", make_mesh, import_scan),
    )
)
