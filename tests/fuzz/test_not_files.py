"""What is no regular file, no file at all or a damaged one in place of any input is rejected in a sentence, at once.

`MODULES` lists every module of both programs that reads a file, with the kinds of files that try it.
"""

from __future__ import annotations

import ast
import contextlib
import os
import signal
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import bpy  # noqa: F401  before the rest, which it would otherwise load anew
import pytest

from fuzz import other_files
from fuzz.run import LONGEST_SENTENCE, ROOT
from fuzz.target import Target, said
from fuzz.targets import TARGETS

LONGEST_S = 300
"""Until what waits is interrupted."""


class Waits(BaseException):
    """It took longer."""


@contextlib.contextmanager
def interrupted() -> Iterator[None]:
    def interrupt(*_: object) -> None:
        raise Waits

    before = signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, LONGEST_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def make_socket(path: Path) -> None:
    with contextlib.chdir(path.parent), socket.socket(socket.AF_UNIX) as one:  # its address may have 107 characters
        one.bind(path.name)


KINDS = {
    "pipe": os.mkfifo,
    "socket": make_socket,
    "folder": Path.mkdir,
    "device": lambda path: path.symlink_to("/dev/zero"),
    "endless": lambda path: path.symlink_to("/proc/self/pagemap"),
    "circle": lambda path: path.symlink_to(path.name),
}
DAMAGED = {
    "absent": None,
    "empty": lambda content: b"",
    "text": lambda content: b"hello world",
    "half": lambda content: content[: len(content) // 2],
    "head": lambda content: content[:20],
}
"""What is there instead of a file's content; None for no file."""


def outcome(target: Target, path: Path, folder: Path) -> str:
    """`rejected` in a sentence that names something in `folder`, `read` without a sentence, or what is wrong."""
    try:
        with interrupted():
            target.read(path)
    except Waits:
        return "WAITS"
    except Exception as error:
        sentence = said(error)
        if sentence is None:
            return f"TRACEBACK {error!r:.300}"
        short = sentence.replace(f"{path.parent}{os.sep}", "")
        named = path.name in sentence or str(folder) in sentence
        good = named and "\n" not in short and len(short) <= LONGEST_SENTENCE
        return "rejected" if good else f"FAULT {sentence}"
    return "read"


OPTIONAL = {
    "human's card", "joints of shots", "depth of a shot", "licences", "shape of a scan", "material of an asset",
    "captures: list", "captures: poses", "captures: completion mark", "captures: pack", "captures: about a pack",
    "hub: commit", "Blender: picture of a scan",
}  # fmt: skip
"""Files that may be missing: what is no file counts as that."""
AS_MISSING = {
    ("captures: settings", "circle"), ("run: settings", "circle"),
    ("run: starts", "circle"), ("run: metrics", "circle"), ("run: metrics", "endless"), ("Blender: scan", "endless"),
    ("Blender: HDRI", "endless"),
}  # fmt: skip
"""A link that leads nowhere is replaced where the program writes such a file; a file of /proc counts as empty."""
NOT_THERE_YET = {
    "run: settings", "run: starts", "run: metrics", "captures: settings", "captures: joints",
    "captures: picture",
}  # fmt: skip
"""Files that the program writes where they are absent, or reads no more than it needs of."""
ANY_CONTENT = {
    "licences", "shape of a scan", "captures: completion mark", "captures: pack", "captures: about a pack",
    "run: metrics", "material of an asset", "Blender: HDRI", "Blender: picture of a scan", "Blender: scan",
}  # fmt: skip
"""Lines of any text, what Blender shows as well as it can, and what is made again or not used where it is damaged."""
STILL_VALID = {("captures: list", "head"), ("captures: picture", "half")}
TOGETHER = "readers of"
"""Targets of this name compare several readers, each of which is tried alone as well."""
FILES = [
    one for one in dict.fromkeys((*TARGETS, *other_files.TARGETS)) if one.is_file and not one.name.startswith(TOGETHER)
]


@pytest.fixture(scope="module")
def valid(tmp_path_factory) -> Callable[[Target], tuple[Path, bytes]]:
    """Where the file of a kind lies, which is made once and below which a test may put anything, and its content."""
    root, found = tmp_path_factory.mktemp("files"), {}

    def valid(target: Target) -> tuple[Path, bytes]:
        folder = root / str(FILES.index(target))
        folder.mkdir(exist_ok=True)
        os.chdir(folder)
        if target.name not in found:
            path = target.make(folder)
            found[target.name] = path, path.read_bytes()
        return found[target.name]

    return valid


def remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        path.rmdir()
    else:
        path.unlink(missing_ok=True)


each_kind = pytest.mark.parametrize("target", FILES, ids=lambda target: target.name)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes have no names here")
@each_kind
def test_what_is_no_file_is_rejected_at_once(target, valid, monkeypatch):
    monkeypatch.chdir(".")  # back in the end
    path, _ = valid(target)
    found = {}
    for kind, put in KINDS.items():
        remove(path)
        put(path)
        found[kind] = outcome(target, path, Path.cwd())
    missing = {kind for kind in KINDS if target.name in OPTIONAL or (target.name, kind) in AS_MISSING}
    wrong = {
        kind: what for kind, what in found.items() if what != "rejected" and not (kind in missing and what == "read")
    }
    assert not wrong


@each_kind
def test_what_is_absent_or_damaged_is_rejected_by_name(target, valid, monkeypatch):
    monkeypatch.chdir(".")
    path, content = valid(target)
    read = set()
    for kind, change in DAMAGED.items():
        remove(path)
        if change:
            path.write_bytes(change(content))
        found = outcome(target, path, Path.cwd())
        assert found in ("rejected", "read"), kind
        read |= {kind} if found == "read" else set()
    if target.name in ANY_CONTENT:
        return
    may = {"absent"} if target.name in OPTIONAL | NOT_THERE_YET else set()
    assert read <= may | {kind for name, kind in STILL_VALID if name == target.name}


def test_the_interruption_ends_what_waits_for_a_pipe(tmp_path, monkeypatch):
    monkeypatch.setattr(f"{__name__}.LONGEST_S", 0.1)
    os.mkfifo(tmp_path / "pipe")
    waits = Target("waits", lambda folder: folder, (), lambda path: path.read_bytes())  # pyright: ignore
    assert outcome(waits, tmp_path / "pipe", tmp_path) == "WAITS"


FORMATS = "it reads for others, with a path of theirs"
OWN = "it reads what ships with the program, or what this program has just written"
BACKEND = {
    "body/model.py": OWN,
    "body/smpl_files.py": ("SMPL .npz", "SMPL .pkl", "UV .obj"),
    "capture/composed.py": ("background of captures",),
    "capture/dataset.py": ("captures: pack", "captures: about a pack"),
    "capture/people_files.py": ("glb",),
    "capture/photograph.py": ("plain picture",),
    "capture/poses.py": OWN,
    "capture/reader.py": ("picture", "captures: cameras", "captures: picture", "captures: first picture"),
    "capture/sheet.py": ("captures: joints",),
    "capture/smpl_parameters.py": ("captures: poses", "captures: pickled poses"),
    "commands/frame_drawer.py": ("solids", "frame"),
    "diffusion/checkpoint.py": ("checkpoint", "encoder", "hub: commit", "hub: weights"),
    "diffusion/pretrained.py": OWN,
    "editing/regions.py": ("painted weights",),
    "evaluation/attribute_network.py": ("attribute network",),
    "evaluation/gallery.py": ("payload of a gallery",),
    "evaluation/onnx_networks.py": ("ONNX network",),
    "evaluation/pose_depth_network.py": ("joints network",),
    "evaluation/pretrained_networks.py": ("network .pth",),
    "evaluation/shots.py": ("shot", "joints of shots", "depth of a shot"),
    "formats/arrays.py": FORMATS,
    "formats/body_layout.py": OWN,
    "formats/capture_layout.py": ("captures: settings", "captures: list", "captures: completion mark"),
    "formats/capture_repair.py": ("captures: completion mark",),
    "formats/json_files.py": FORMATS,
    "formats/picture_files.py": FORMATS,
    "formats/poses/bvh.py": ("BVH", "motion .bvh"),
    "formats/poses/files.py": (
        "AMASS",
        "motion .npy",
        "motion .json",
        "poses .npy",
        "poses .npz",
        "poses .json",
        "poses .pkl",
        "MHR .npz",
        "MHR .json",
        "pose",
        "pose .npz",
    ),
    "formats/regular_files.py": FORMATS,
    "geometry/pictures.py": FORMATS,
    "human_file.py": ("human", "compact human"),
    "people/assets.py": ("licences", "material of an asset", "texture of an asset"),
    "people/base_mesh.py": OWN,
    "people/folder.py": ("human's card", "manifest"),
    "people/mhclo.py": ("mhclo", "obj"),
    "people/payloads.py": ("payload",),  # whatever cannot be read is made again
    "posture/file.py": ("posture",),
    "primitives/body_setup.py": ("SMPL .npz", "SMPL .pkl", "UV .obj"),
    "released/reading.py": ("released checkpoint",),
    "render/cpu_compiled.py": OWN,
    "tensor_file.py": FORMATS,
    "torch_file.py": FORMATS,
    "training/captured_people.py": ("human's card", "payload"),
    "training/cells.py": ("run: latents",),
    "training/fit_voxels.py": ("fitted voxels",),
    "training/run_folder.py": ("run: settings", "run: starts", "run: metrics"),
    "training/shards.py": ("packed index", "packed shard"),
    "training/state.py": ("training state",),
    "training/stored_people.py": ("payload",),
}
EXTENSION = {
    "backend/packages.py": ("lock of packages",),
    "backend/setup.py": OWN,  # and looks at wheels: tests/contract/test_setup_environment.py
    "capture/body.py": ("body of captures",),
    "capture/cameras.py": ("Blender: plain picture",),
    "capture/command.py": ("cameras",),
    "capture/passes.py": ("picture of Cycles",),
    "capture/scan_files.py": ("shape of a scan", "parameters of a scan", "Blender: scan"),
    "capture/stage.py": ("Blender: HDRI",),
    "capture/surfaces.py": ("Blender: picture of a scan",),
    "engine/studio.py": OWN,
    "jobs/assets.py": ("Blender: preview",),
    "jobs/from_picture.py": OWN,
    "motion/pose_library.py": ("own pose",),
    "scene/rest_human.py": ("body file",),
    "scene/human.py": ("human in Blender",),
    "scene/human_file.py": (
        "human in Blender",
        "compact human in Blender",
        "moving human in Blender",
        "small human in Blender",
        "body file",
    ),
    "scene/merged.py": ("merged grid",),
    "scene/proxy.py": ("proxy",),
    "scene/volumes.py": "it reads the header of a regular file; any other has no format",
    "ui/attributes.py": ("vocabulary",),
}
MODULES: dict[str, tuple[str, ...] | str] = {
    **{f"backend/primdiffusion/{name}": tried for name, tried in BACKEND.items()},
    **{f"blender_primdiffusion/{name}": tried for name, tried in EXTENSION.items()},
}
"""What tries each module that reads a file, or why nothing does."""
READERS = {
    "open_regular", "read_regular", "check_regular", "read_json", "read_arrays", "read_numbers", "array_names",
    "array_shape", "read_npy", "map_npy", "read_pickled_bytes", "stored_members", "opened_picture",
    "is_whole_picture", "read_body_file", "read_metadata", "memmap", "fromfile", "InferenceSession",
    "open_mainfile", "gltf", "fbx", "fbx_import", "obj_import",
}  # fmt: skip
DOTTED = (
    "tensor_file.read",
    "tensor_file.opened",
    "torch_file.load",
    "images.load",
    "libraries.load",
    "FileContent.read",
)


ENDS = {name.rpartition(".")[2] for name in DOTTED}


def _is_reader(called: ast.expr) -> bool:
    if isinstance(called, ast.Name):
        return called.id in READERS
    return isinstance(called, ast.Attribute) and (
        called.attr in READERS or (called.attr in ENDS and ast.unparse(called).endswith(DOTTED))
    )


def reading_modules() -> set[str]:
    """Modules that call a reader, by their path in the repository."""
    found = set()
    for root in (ROOT / "backend" / "primdiffusion", ROOT / "blender_primdiffusion"):
        for path in root.rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Call) and _is_reader(node.func):
                    found.add(path.relative_to(ROOT).as_posix())
    return found


def test_every_module_that_reads_a_file_is_tried():
    assert set(MODULES) == reading_modules()
    tried = [kinds for kinds in MODULES.values() if not isinstance(kinds, str)]
    assert {name for kinds in tried for name in kinds} == {target.name for target in FILES}
    assert all(tried)
