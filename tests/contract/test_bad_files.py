"""Damaged and hostile files of every kind: one sentence that names the file, nothing run, nothing written.

A reader of a new kind gets a line in KINDS; a new way to lie about a kind's size, shape or numbers one in CLAIMS.
"""

import contextlib
import dataclasses
import io
import json
import os
import pickle
import re
import struct
import time
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import amass_files
import bvh_files
import capture_scenes
import diffusion_people
import numpy as np
import pytest
import released_files
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image
from primdiffusion.body.model import read_pose
from primdiffusion.body.smpl_files import load_body
from primdiffusion.capture.people_files import read_person
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.evaluation.pretrained_networks import read_weights
from primdiffusion.files import tensor_file
from primdiffusion.files.arrays import read_npy
from primdiffusion.files.regular_files import as_file_error
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.formats.poses.files import read_motion
from primdiffusion.formats.poses.skeleton import REST_JOINTS
from primdiffusion.geometry.pictures import decoded, opened_picture
from primdiffusion.human import generate
from primdiffusion.human_file import load_human, save_human
from primdiffusion.people.stored_people import read_payloads
from primdiffusion.runtime.failures import to_user_error
from support.tiny import save_tiny_checkpoint, tiny_model

LONGEST_SENTENCE, LONGEST_S, MOST_MEMORY = 300, 5.0, 500 * 2**20


@dataclasses.dataclass(frozen=True)
class Kind:
    """A kind of file."""

    make: Callable[[Path], Path]
    """Writes a valid file into an empty folder; returns its path."""
    read: Callable[[Path], object]
    """What reads it."""


def human(folder: Path) -> Path:
    save_human(folder / "a.human.safetensors", generate(tiny_model(), seed=3, steps=2))
    return folder / "a.human.safetensors"


def weights(folder: Path, **how: bool) -> Path:
    torch.save({"a": torch.arange(100.0), "b": torch.ones(3, 4)}, folder / "weights.pth", **how)
    return folder / "weights.pth"


def smpl_npz(folder: Path) -> Path:
    released_files.save_body(folder)  # with the texture coordinates
    arrays = released_files.body_arrays()
    arrays["J_regressor"] = arrays["J_regressor"].toarray()  # pyright: ignore[reportAttributeAccessIssue]
    np.savez(folder / "body.npz", **arrays)  # pyright: ignore[reportArgumentType]
    return folder / "body.npz"


def read_smpl(path: Path) -> object:
    return load_body(path, path.with_name("smpl_uv.obj"))


def depth(folder: Path) -> Path:
    np.save(folder / "depth.npy", np.ones((4, 5), np.float32))
    return folder / "depth.npy"


def pose(folder: Path) -> Path:
    (folder / "pose.json").write_text(json.dumps({"pose": np.zeros((24, 3)).tolist(), "translation": [0, 0.5, 0]}))
    return folder / "pose.json"


def bvh(folder: Path) -> Path:
    return bvh_files.write_bvh(
        folder / "a.bvh", REST_JOINTS, *bvh_files.motion_of(), {name: name for name in JOINT_NAMES}
    )


def payload(folder: Path) -> Path:
    diffusion_people.write_people(folder, 1, variants=1)
    return next(folder.glob("person_*.npz"))


def picture(folder: Path) -> Path:
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (24, 24, 3), np.uint8)).save(folder / "a.png")
    return folder / "a.png"


def read_picture(path: Path) -> None:
    with as_file_error(path, "cannot be read", "choose another picture"), opened_picture(path) as opened:
        decoded(opened, "RGB")


KINDS = {
    "human": Kind(human, load_human),
    "checkpoint": Kind(lambda folder: save_tiny_checkpoint(folder / "model.safetensors"), load_checkpoint),
    "weights": Kind(weights, read_weights),
    "old weights": Kind(lambda folder: weights(folder, _use_new_zipfile_serialization=False), read_weights),
    "SMPL npz": Kind(smpl_npz, read_smpl),
    "SMPL pkl": Kind(lambda folder: released_files.save_body(folder)[0], read_smpl),
    "pose": Kind(pose, read_pose),
    "BVH": Kind(bvh, read_motion),
    "AMASS": Kind(lambda folder: Path(amass_files.write_amass(folder / "a.npz", frames=4)), read_motion),
    "depth": Kind(depth, read_npy),
    "payload": Kind(payload, read_payloads),
    "picture": Kind(picture, read_picture),
    "glb": Kind(lambda folder: capture_scenes.save_person(folder / "person.glb"), read_person),
}


class Canary:
    """Pickled, it makes a file when it is loaded."""

    def __reduce__(self):
        return os.mkdir, ("CANARY",)


HOSTILE = pickle.dumps(Canary(), 2)


DAMAGE: dict[str, Callable[[bytes], bytes]] = {
    "truncated": lambda content: content[: len(content) // 2],
    "nearly empty": lambda content: content[:3],
    "empty": lambda _: b"",
    "wrong magic": lambda content: b"\x89wrong\r\n" + content[8:],
    "hostile pickle": lambda _: HOSTILE,
    "huge header": lambda content: b"\xff" * 7 + b"\x00" + content[8:],
    "deep nesting": lambda _: b"[" * 100_000,
}


def with_tensor(path: Path, name: str, change: Callable[[torch.Tensor], torch.Tensor]) -> None:
    tensors, metadata = tensor_file.read(path)
    path.write_bytes(tensor_file.save({**tensors, name: change(tensors[name])}, metadata))


def with_array(path: Path, name: str, change: Callable[[np.ndarray], np.ndarray]) -> None:
    with np.load(path) as file:
        arrays = dict(file)
    np.savez(path, **{**arrays, name: change(arrays[name])})  # pyright: ignore[reportArgumentType]


def with_member(path: Path, name: str, content: bytes, method: int = zipfile.ZIP_STORED) -> None:
    with zipfile.ZipFile(path) as old:
        members = {one: old.read(one) for one in old.namelist()}
    (member,) = (one for one in members if one.endswith(name))
    with zipfile.ZipFile(path, "w", method) as archive:
        for one, data in {**members, member: content}.items():
            archive.writestr(one, data)


def npy(shape: str, data: bytes = b"", kind: str = "<f8") -> bytes:
    head = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + data


def objects() -> bytes:
    made = io.BytesIO()
    np.save(made, np.array([Canary()], dtype=object), allow_pickle=True)
    return made.getvalue()


def replaced(old: bytes, new: bytes) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        content = path.read_bytes()
        assert old in content
        path.write_bytes(content.replace(old, new, 1))

    return change


def nan(values):
    changed = values.clone() if isinstance(values, torch.Tensor) else values.copy()
    changed.reshape(-1)[0] = float("nan")
    return changed


STORAGE = (
    b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n((X\x07\x00\x00\x00storagectorch\nFloatStorage\nX\x01\x00\x00\x000"
    b"X\x03\x00\x00\x00cpu%stQK\x00%s\x85K\x01\x85\x89ccollections\nOrderedDict\n)RtR."
)
LARGE = b"\x8a\x08" + struct.pack("<q", 10**11)
TAKES_MEMORY = b"\x80\x02cbuiltins\nbytearray\n\x8a\x08" + struct.pack("<q", 10**10) + b"\x85R."


def png_of(width: int, height: int) -> bytes:
    made = io.BytesIO()
    Image.new("L", (8, 8)).save(made, "png")
    content = bytearray(made.getvalue())
    content[16:24] = struct.pack(">II", width, height)
    content[29:33] = struct.pack(">I", zlib.crc32(content[12:29]))
    return bytes(content)


CLAIMS: dict[tuple[str, str], Callable[[Path], object]] = {
    ("human", "wrong shape"): lambda path: with_tensor(path, "rgb", lambda values: values[:512].contiguous()),
    ("human", "NaN"): lambda path: path.write_bytes(path.read_bytes()[:-4] + b"\xff\xff\xff\x7f"),
    ("human", "huge size"): replaced(b'"shape":[1024,3,8,8,8]', b'"shape":[1024,3,8,99999]'),
    ("checkpoint", "NaN"): lambda path: path.write_bytes(path.read_bytes()[:-4] + b"\xff\xff\xff\x7f"),
    ("weights", "hostile member"): lambda path: with_member(path, "data.pkl", HOSTILE),
    ("weights", "zip bomb"): lambda path: with_member(path, "data/0", bytes(100 * 2**20), zipfile.ZIP_DEFLATED),
    ("weights", "huge tensor"): lambda path: with_member(path, "data.pkl", STORAGE % (b"K\x02", LARGE)),
    ("weights", "huge storage"): lambda path: with_member(path, "data.pkl", STORAGE % (LARGE, LARGE)),
    ("weights", "huge call"): lambda path: with_member(path, "data.pkl", TAKES_MEMORY),
    ("old weights", "huge call"): lambda path: path.write_bytes(TAKES_MEMORY),
    ("SMPL npz", "NaN"): lambda path: with_array(path, "v_template", nan),
    ("SMPL npz", "wrong shape"): lambda path: with_array(path, "weights", lambda values: values[:, :5]),
    ("SMPL npz", "hostile member"): lambda path: with_member(path, "v_template.npy", objects()),
    ("pose", "wrong shape"): lambda path: path.write_text('{"pose": [[0, 0, 0]]}'),
    ("pose", "NaN"): replaced(b"0.0", b"NaN"),
    ("pose", "huge number"): replaced(b"0.0", b"1e999"),
    ("BVH", "NaN"): replaced(b"Frame Time: 0", b"Frame Time: nan"),
    ("BVH", "huge size"): replaced(b"Frames: ", b"Frames: 9999999999"),
    ("AMASS", "NaN"): lambda path: with_array(path, "poses", nan),
    ("AMASS", "wrong shape"): lambda path: with_array(path, "poses", lambda values: values[:, :9]),
    ("AMASS", "huge size"): lambda path: with_member(path, "poses.npy", npy("(9999999999, 156)")),
    ("AMASS", "hostile member"): lambda path: with_member(path, "poses.npy", objects()),
    ("AMASS", "zip bomb"): lambda path: with_member(
        path, "poses.npy", npy("(84000, 156)", bytes(84000 * 156 * 8)), zipfile.ZIP_DEFLATED
    ),
    ("depth", "hostile array"): lambda path: path.write_bytes(objects()),
    ("depth", "huge size"): lambda path: path.write_bytes(npy("(9999999999, 156)")),
    ("payload", "wrong shape"): lambda path: with_array(path, "betas", lambda values: values[:3]),
    ("payload", "NaN"): lambda path: with_array(path, "betas", nan),
    ("payload", "huge size"): lambda path: with_member(path, "betas.npy", npy("(9999999999,)")),
    ("picture", "huge size"): lambda path: path.write_bytes(png_of(60_000, 60_000)),
}
"""What a valid file of a kind is changed to."""


def linked_in_a_circle(path: Path) -> None:
    path.unlink()
    path.symlink_to(path.name)


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


PLACES: dict[str, Callable[[Path], object]] = {
    "missing": Path.unlink, "a circle of links": linked_in_a_circle, "a pipe": pipe,
}  # fmt: skip
"""What takes the place of a file."""


@pytest.fixture(scope="module")
def valid(tmp_path_factory) -> Callable[[str], Path]:
    made: dict[str, Path] = {}

    def of(kind: str) -> Path:
        if kind not in made:
            made[kind] = KINDS[kind].make(tmp_path_factory.mktemp("valid"))
        return made[kind]

    return of


@pytest.fixture
def copy(valid, tmp_path, monkeypatch) -> Callable[[str], Path]:
    def of(kind: str) -> Path:
        whole, folder = valid(kind), tmp_path / "folder"
        folder.mkdir(exist_ok=True)
        monkeypatch.chdir(folder)
        for file in whole.parent.iterdir():
            if file.is_file():
                (folder / file.name).write_bytes(file.read_bytes())
        return folder / whole.name

    return of


def memory(which: str) -> int:
    """A figure of this process, bytes: VmRSS of now, VmHWM of its peak; 0 where the system does not tell."""
    with contextlib.suppress(OSError):
        return 1024 * int(re.search(rf"{which}:\s+(\d+)", Path("/proc/self/status").read_text())[1])  # type: ignore[index]
    return 0


@contextlib.contextmanager
def within_limits(folder: Path) -> Iterator[None]:
    before = sorted(folder.rglob("*"))
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")  # the peak is counted from here
    held, seconds = memory("VmRSS"), time.process_time()
    yield
    assert sorted(folder.rglob("*")) == before, "a file was written, or removed"
    assert memory("VmHWM") - held < MOST_MEMORY
    assert time.process_time() - seconds < LONGEST_S


def assert_one_sentence(error: Exception, name: str) -> None:
    found = to_user_error(error)
    assert found is not None, f"a traceback: {error!r}"
    assert name in found.sentence
    assert "\n" not in found.sentence
    assert len(re.sub(r"/\S*/", "", found.sentence)) < LONGEST_SENTENCE


def assert_refused(kind: str, path: Path) -> None:
    name = path.name
    with warnings.catch_warnings(), within_limits(path.parents[1]):
        warnings.simplefilter("ignore")
        with pytest.raises(Exception) as caught:
            KINDS[kind].read(path)
    assert_one_sentence(caught.value, name)


@pytest.mark.parametrize("kind", KINDS)
def test_a_whole_file_is_read(copy, kind):
    KINDS[kind].read(copy(kind))


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("kind", KINDS)
def test_a_damaged_file_is_one_sentence(copy, kind, damage):
    path = copy(kind)
    path.write_bytes(DAMAGE[damage](path.read_bytes()))
    assert_refused(kind, path)


@pytest.mark.parametrize(("kind", "claim"), CLAIMS)
def test_what_a_file_claims_is_checked(copy, kind, claim):
    path = copy(kind)
    CLAIMS[kind, claim](path)
    assert_refused(kind, path)


@pytest.mark.unix
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("kind", KINDS)
def test_what_is_not_a_file_is_not_opened(copy, kind, place):
    path = copy(kind)
    PLACES[place](path)
    assert_refused(kind, path)


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_bytes_that_change_anywhere_are_read_or_one_sentence(copy, kind, data):
    path = copy(kind)
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.one_of(st.integers(0, len(content)), st.integers(0, min(400, len(content)))))
        content[place : place + data.draw(st.integers(0, 8))] = data.draw(st.binary(max_size=8))
    path.write_bytes(content)
    with warnings.catch_warnings(), within_limits(path.parents[1]):
        warnings.simplefilter("ignore")
        try:
            KINDS[kind].read(path)
        except Exception as error:
            assert_one_sentence(error, path.name)
