"""A synthetic person in a scene, and what the child would make of them, for tests of exports."""

from __future__ import annotations

import json
from pathlib import Path

import bpy
import numpy as np
import synthetic

from blender_primdiffusion.scene.build import build_human


def write_store(folder: Path) -> None:
    """human.npz, proxy.npz, proxy.png and person.human.safetensors of one person."""
    synthetic.write(folder / "human.npz", 8)
    arrays = synthetic.arrays(8)
    parts = {name: arrays[name] for name in ("joints", "vertices", "faces", "uv_corner", "skin_weights")}
    np.savez(folder / "proxy.npz", format_version=1, joint_names=np.array(synthetic.NAMES), **parts)
    picture = bpy.data.images.new("texture", 16, 16)
    pixels = np.zeros((16, 16, 4), np.float32)
    pixels[..., 0], pixels[..., 3] = 1.0, 1.0
    picture.pixels.foreach_set(pixels.ravel())
    picture.filepath_raw, picture.file_format = str(folder / "proxy.png"), "PNG"
    picture.save()
    bpy.data.images.remove(picture)
    write_person(folder / "person.human.safetensors")


def write_person(path: Path, betas: np.ndarray | None = None, **metadata: str) -> None:
    """A small safetensors file with a person's metadata, on a body of the user's files: the child opens it."""
    raw = np.asarray(synthetic.arrays(8)["betas"] if betas is None else betas, "<f4").tobytes()
    about = {"format": "primdiffusion.human", "format_version": "2", "body": "{}"}
    about |= {"provenance": json.dumps({"seed": 5}), **metadata}
    header = {"__metadata__": about, "betas": {"dtype": "F32", "shape": [10], "data_offsets": [0, len(raw)]}}
    text = json.dumps(header).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + raw)


def add_person(store: Path, name: str = "Anna") -> bpy.types.Collection:
    """Built in the scene, with the backend's file beside the volumes; the armature is active."""
    person = build_human(bpy.context, store / "human.npz", name, [store / "person.human.safetensors"])
    bpy.context.view_layer.objects.active = person.objects[0]
    return person
