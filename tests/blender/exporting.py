"""A synthetic person in a scene, and what the child would make of them, for tests of exports."""

from pathlib import Path

import bpy
import numpy as np
import synthetic
from support import tensor_files

from blender_primdiffusion.scene.build import build_human


def write_store(folder: Path) -> None:
    """person.human.safetensors, body.safetensors, proxy.npz and proxy.png of one person."""
    synthetic.write(folder, 8)
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


def write_person(path: Path, betas: np.ndarray | None = None, **metadata: str) -> None:
    """A small person's file, on a body of the user's files that is not beside it: the child opens it."""
    arrays = synthetic.arrays(8)
    arrays["betas"] = arrays["betas"] if betas is None else betas
    tensor_files.write_human(path, arrays, {"seed": 5})
    path.with_name(tensor_files.BODY).unlink()
    tensors, about = tensor_files.read_tensors(path)
    tensor_files.write_tensors(path, tensors, {**about, **metadata})


def add_person(store: Path, name: str = "Anna") -> bpy.types.Object:
    """Built in the scene, with the backend's file beside the volumes; the armature is active."""
    person = build_human(bpy.context, store / "person.human.safetensors", name)
    bpy.context.view_layer.objects.active = person
    return person
