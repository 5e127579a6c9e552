"""A person comes to be: from human.npz to one collection in the scene."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import bpy
import numpy as np

from . import volumes
from .armature import build_armature
from .attach import attach_volumes
from .body_mesh import build_body_mesh
from .convention import frames_to_blender, points_to_blender
from .human import BETAS, HOME, MARK, PERSON, folder_of
from .human_file import HumanFile, read_human
from .material import volume_material
from .overlap import most_overlapping
from .placing_files import free_name
from .shape_file import body_kept

_NAME_LENGTH = 40
_KINDS = ("collections", "objects", "volumes", "meshes", "armatures", "actions", "materials")


def build_human(
    context: bpy.types.Context, human_npz: str | Path, name: str = "Human", keep: Sequence[Path] = ()
) -> bpy.types.Collection:
    """Build the person of a human.npz in the scene: armature, hidden body mesh and a volume for every primitive.

    The person faces -y with the soles on z = 0 at the world's origin: the armature object is lifted, its space is the
    backend's turned z up. Volumes are written to `folder_of(collection)`, the files in `keep` are copied beside them,
    and the body's file is put beside that folder. Raises HumanFileError or VolumeWriteError, and then leaves neither
    data nor files. Takes several seconds; makes no undo step, its caller does.
    """
    human = read_human(human_npz)
    with _nothing_left_on_failure():
        collection = bpy.data.collections.new(name[:_NAME_LENGTH])
        label = collection.name
        armature = build_armature(context, label, points_to_blender(human.joints))
        armature[BETAS] = human.betas.tolist()
        armature.id_properties_ui(BETAS).update(description="Shape of the body, drawn by the engine PrimDiffusion")
        collection.objects.link(armature)
        vertices = points_to_blender(human.vertices)
        armature.location = (0.0, 0.0, -vertices[:, 2].min())
        body = build_body_mesh(f"{label}_body", armature, vertices, human.faces, human.uv_corner, human.skin_weights)
        collection.objects.link(body)
        primitives = bpy.data.collections.new(f"{label}_primitives")
        collection.children.link(primitives)
        rotation = frames_to_blender(human.rotation)
        grids = volumes.bake(human.density, human.rgb, human.half_extent)
        home = folder_of(collection)
        kept = {free_name(path, home, path.name): path for path in keep}
        with (
            volumes.written(grids, home, kept) as files,
            body_kept(collection, human.shape_model, home.parent),
        ):
            attach_volumes(
                label,
                armature,
                primitives,
                files,
                points_to_blender(human.position),
                rotation,
                human.primitive_weights,
                volume_material(),
            )
            collection[MARK] = provenance(human, grids)
            collection[HOME] = str(home)
            for name, path in kept.items():
                if name != path.name:  # the usual name is taken by somebody who was deleted
                    collection[PERSON] = name
            context.scene.collection.children.link(collection)
    return collection


def provenance(human: HumanFile, grids: volumes.Grids) -> str:
    """What `MARK` holds: where the person comes from, their betas, and how many boxes meet at most."""
    offset, half = grids.drawn_box()
    centre = human.position + np.einsum("kij,kj->ki", human.rotation, offset)
    most = most_overlapping(centre, human.rotation, half)
    return json.dumps({**human.meta, "betas": np.round(human.betas, 6).tolist(), "most_overlapping": most})


@contextmanager
def _nothing_left_on_failure() -> Iterator[None]:
    """When the block fails, remove every datablock made in it."""
    before = {kind: set(getattr(bpy.data, kind)) for kind in _KINDS}
    try:
        yield
    except BaseException:
        new = [thing for kind in _KINDS for thing in getattr(bpy.data, kind) if thing not in before[kind]]
        bpy.data.batch_remove(new)
        raise
