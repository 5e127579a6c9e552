"""What `small_inputs` reads: files below a megabyte, and the readers that get them."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np

from fuzz.claims import COLOUR, many_scans, png, zeros

# --- pictures


def small_picture(folder: Path) -> Path:
    (folder / "a.png").write_bytes(png(64, 64))
    return folder / "a.png"


def picture(width: int, height: int, colour: int = COLOUR, bits: int = 8) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / "a.png").write_bytes(png(width, height, colour, bits))
        return folder / "a.png"

    return make


def scanned_picture(folder: Path) -> Path:
    (folder / "a.jpg").write_bytes(many_scans(4096, 2000))
    return folder / "a.jpg"


def read_asset(path: Path) -> object:
    from primdiffusion.people.assets import _decoded

    return _decoded(path, 1024)


def read_shots(path: Path) -> object:
    from primdiffusion.evaluation.shots import folder_shots

    return list(folder_shots(path.parent))


def read_capture(kind: str) -> Callable[[Path], object]:
    def read(path: Path) -> object:
        from PIL import Image
        from primdiffusion.capture.reader import _KINDS, _opened, _read

        Image.MAX_IMAGE_PIXELS = None
        with Image.open(path) as opened:
            width, height = opened.size
        with _opened(path) as file:
            return _KINDS[kind](_read(file, path, kind, width, height))

    return read


# --- meshes


def small_glb(folder: Path) -> Path:
    from capture_scenes import save_person

    return save_person(folder / "person.glb")


def glb(side: int, materials: int, nodes: int = 1, tinted: bool = False, alpha: bool = False) -> Callable[[Path], Path]:
    """A human of `nodes` copies of `materials` parts, whose materials share one picture."""

    def make(folder: Path) -> Path:
        path = small_glb(folder)
        content = path.read_bytes()
        length = int.from_bytes(content[12:16], "little")
        tree, binary = json.loads(content[20 : 20 + length]), content[28 + length :]
        picture = png(side, side)
        tree["images"] = [{"bufferView": len(tree["bufferViews"]), "mimeType": "image/png"}]
        tree["bufferViews"].append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(picture)})
        tree["textures"] = [{"source": 0}]
        surface = {"baseColorTexture": {"index": 0}}
        tree["materials"] = [
            {
                "pbrMetallicRoughness": {**surface, "baseColorFactor": [1 - 0.01 * number * tinted, 1, 1, 1]},
                "alphaMode": "BLEND" if alpha else "OPAQUE",
            }
            for number in range(materials)
        ]
        primitive = tree["meshes"][0]["primitives"][0]
        tree["meshes"] = [{"primitives": [{**primitive, "material": number} for number in range(materials)]}]
        joints = [node for node in tree["nodes"] if "mesh" not in node]
        tree["nodes"] = [*joints, *({"name": f"part {n}", "mesh": 0, "skin": 0} for n in range(nodes))]
        return write_glb(path, tree, binary + picture)

    return make


def many_corners(folder: Path) -> Path:
    """A human of 100 parts with the same faces, a byte a corner."""
    path = small_glb(folder)
    content = path.read_bytes()
    length = int.from_bytes(content[12:16], "little")
    tree, binary = json.loads(content[20 : 20 + length]), content[28 + length :]
    corners = 900_000
    tree["bufferViews"].append({"buffer": 0, "byteOffset": len(binary), "byteLength": corners})
    view = len(tree["bufferViews"]) - 1
    tree["accessors"].append({"bufferView": view, "componentType": 5121, "count": corners, "type": "SCALAR"})
    primitive = {**tree["meshes"][0]["primitives"][0], "indices": len(tree["accessors"]) - 1}
    tree["meshes"] = [{"primitives": [primitive] * 100}]
    joints = [node for node in tree["nodes"] if "mesh" not in node]
    tree["nodes"] = [*joints, {"name": "part", "mesh": 0, "skin": 0}]
    return write_glb(path, tree, binary + bytes(corners))


def write_glb(path: Path, tree: object, binary: bytes) -> Path:
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    path.write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks)
    return path


def read_glb(path: Path) -> object:
    from primdiffusion.capture.people_files import read_person
    from primdiffusion.raster.textures import texture_pyramid

    mesh = read_person(path).mesh
    return mesh, texture_pyramid(mesh)


# --- poses and motion


def motion(*arrays: tuple[str, str, tuple[int, ...]], noise: int = 0) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        return zeros(folder / "a.npz", {name: (kind, shape) for name, kind, shape in arrays}, noise=noise)

    return make


def matrices(frames: int) -> Callable[[Path], Path]:
    """Rotation matrices, all the identity, in the smallest type."""

    def make(folder: Path) -> Path:
        np.savez_compressed(folder / "a.npz", pose=np.broadcast_to(np.eye(3, dtype=np.int8), (frames, 24, 3, 3)))
        return folder / "a.npz"

    return make


def small_motion(folder: Path) -> Path:
    return motion(("poses", "f4", (4, 72)))(folder)


def read_motion(path: Path) -> object:
    from blender_primdiffusion.formats.poses.files import read_motion

    return read_motion(path)


def read_poses(path: Path) -> object:
    from primdiffusion.pose_file import read_motion

    return read_motion(path)


def read_pose(path: Path) -> object:
    from primdiffusion.pose_file import read_pose

    return read_pose(path)


def captured_poses(frames: int) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        from primdiffusion.formats.capture_layout import SMPL_FOLDER, SMPL_PLAIN_FILE

        shapes = {"global_orient": (frames, 3), "body_pose": (frames, 69), "transl": (frames, 3)}
        (folder / SMPL_FOLDER).mkdir()
        arrays = {name: ("i1", shape) for name, shape in shapes.items()}
        return zeros(folder / SMPL_FOLDER / SMPL_PLAIN_FILE, arrays, betas=[0.0] * 10)

    return make


def read_captured_poses(path: Path) -> object:
    from primdiffusion.capture.smpl_parameters import read_smpl

    return read_smpl(path.parents[1])


def bvh(frames: int, extra: int = 0) -> Callable[[Path], Path]:
    """A motion of which the root alone turns about one axis, two characters a frame; with `extra` joints."""

    def make(folder: Path) -> Path:
        from blender_primdiffusion.formats.poses.skeleton import REST_JOINTS
        from bvh_files import motion_of, write_bvh
        from primdiffusion.formats.joints import JOINT_NAMES

        path = write_bvh(folder / "a.bvh", REST_JOINTS, *motion_of(), {name: name for name in JOINT_NAMES})
        head = path.read_text().split("MOTION")[0]
        lines = ["CHANNELS 0" if "CHANNELS" in line else line for line in head.splitlines()]
        first = lines.index("CHANNELS 0")
        lines[first] = "CHANNELS 1 Xrotation"
        lines[first + 1 : first + 1] = ["JOINT extra { OFFSET 0 0 0 CHANNELS 0 }"] * extra
        lines += ["MOTION", f"Frames: {frames}", "Frame Time: 0.01", "0 " * frames]
        path.write_text("\n".join(lines))
        return path

    return make


# --- training data


def small_shards(folder: Path) -> Path:
    from fuzz.data_targets import make_packed

    return make_packed(folder)


def repeated_shard(folder: Path) -> Path:
    """An index that lists one shard a thousand times."""
    path = small_shards(folder)
    index = json.loads(path.read_text(encoding="utf-8"))
    index["shards"] = index["shards"][:1] * 1000
    path.write_text(json.dumps(index), encoding="utf-8")
    return path


def negative_variants(folder: Path) -> Path:
    """A shard with a billion colourings of one human, which another takes away again."""
    import torch
    from primdiffusion.training.shards import digest_of
    from safetensors.torch import load_file, save_file

    path = small_shards(folder)
    index = json.loads(path.read_text(encoding="utf-8"))
    first = index["shards"][0]
    first["people"] = [{**first["people"][0], "variants": 10**9}, {**first["people"][0], "variants": 1 - 10**9}]
    path.write_text(json.dumps(index), encoding="utf-8")
    shard = path.with_name(first["file"])
    tensors = load_file(shard)
    save_file({**tensors, "betas": torch.zeros(2, 10)}, shard)
    first["sha256"] = digest_of(shard)
    path.write_text(json.dumps(index), encoding="utf-8")
    return path


def read_shards(path: Path) -> object:
    from primdiffusion.training.shards import PackedPeople

    people = PackedPeople(path.parent)
    return [people.known(number) for number in range(len(people.names))]


def payload(count: int, scales: int) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        arrays = {"voxels": ("u1", (count, 1024, 8, 8, 8, 4))}
        if scales:
            arrays["delta_scale"] = ("f2", (scales, 1024, 3))
        small = {"betas": np.zeros(10), "attributes": np.array("{}"), "full_density": np.array(100.0)}
        return zeros(folder / "person_000000.npz", arrays, **small)

    return make


def read_payload(path: Path) -> object:
    from primdiffusion.training.stored_people import read_person

    return read_person(path)


# --- bodies


def small_body(folder: Path) -> Path:
    from fuzz.targets import make_smpl_npz

    return make_smpl_npz(folder)


def small_pickle(folder: Path) -> Path:
    from fuzz.targets import make_smpl_pickle

    return make_smpl_pickle(folder)


def many_faces(folder: Path) -> Path:
    """A body whose faces are all the same, millions of them."""
    path = small_body(folder)
    with np.load(path) as archive:
        kept = {name: archive[name] for name in archive.files if name not in ("f", "vt", "ft")}
    return zeros(path, {"f": ("i1", (20_000_000, 3))}, **kept)


def shared_lists(folder: Path) -> Path:
    """A pickle whose arrays are lists of lists of one list, ten million numbers in a few kilobytes."""
    import pickle

    row, block = [0.5] * 3, [[0.5] * 100] * 3
    content = {name: [block] * 30_000 for name in ("shapedirs", "posedirs", "weights", "J_regressor")}
    content |= {"v_template": [row] * 30_000, "f": [[0, 1, 2]] * 100_000}
    (folder / "body.pkl").write_bytes(pickle.dumps(content, 2))
    return folder / "body.pkl"


def read_body(path: Path) -> object:
    from primdiffusion.body.smpl_files import load_body

    return load_body(path)


def weights(count: int, noise: int = 0) -> Callable[[Path], Path]:
    return lambda folder: zeros(folder / "a.npz", {"weights": ("i1", (count,))}, noise=noise)


def read_weights(path: Path) -> object:
    from primdiffusion.editing.regions import read_weights

    return read_weights(path)
