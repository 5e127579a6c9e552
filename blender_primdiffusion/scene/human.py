"""The human as a whole: from human.npz to one collection in the scene, and away again."""

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
from .human_file import HumanFile, read_human
from .material import volume_material
from .overlap import CYCLES_LIMIT, most_overlapping
from .placing_files import free_name
from .shape_file import body_kept

MARK = "primdiffusion_human"
"""Custom property of a person's collection: its provenance as JSON."""
BETAS = "primdiffusion_betas"
"""Custom property of a person's armature: the body's shape, which the engine draws and which may be animated."""
PERSON_FILE = "person.human.safetensors"
"""The person as the backend keeps it, beside the volumes."""
PERSON = "primdiffusion_person_file"
"""Custom property of a person's collection: the name of the backend's file since the person was edited. It goes back
and forth with undo, as the paths of the volumes do."""
HOME = "primdiffusion_folder"
"""Custom property of a person's collection: the absolute folder of their files when the .blend was last saved. Paths
of volumes are relative to the .blend, which may be moved alone, or opened as a copy in a temporary folder."""
_NAME_LENGTH = 40
_KINDS = ("collections", "objects", "volumes", "meshes", "armatures", "actions", "materials")


class MissingPersonFile(FileNotFoundError):
    """The backend's file of a person is not where it should be."""

    kind = "missing_volumes"
    """By which panels find the remedy."""


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


def folder_of(collection: bpy.types.Collection) -> Path:
    """Where a person's files live: `<blendname>_humans/<collection name>` (see `humans_folder`)."""
    return volumes.humans_folder() / bpy.path.clean_name(collection.name)


def person_file(collection: bpy.types.Collection) -> Path:
    """The backend's own file of a person: beside their volumes, wherever these are now, else in `folder_of`.

    Volumes keep their paths when a collection is renamed and when a .blend is saved elsewhere. Raises FileNotFoundError
    with a sentence that names the person and the file.
    """
    name, folders = person_file_name(collection), folders_of(collection)
    for folder in folders:
        if (folder / name).is_file():
            return folder / name
    raise MissingPersonFile(
        f"the file of the person {collection.name!r} is missing: {str(folders[0] / name)!r}; put it back beside "
        "the person's volumes, press Find Missing Volumes in the panel Human, or generate the person again"
    )


def folders_of(collection: bpy.types.Collection) -> list[Path]:
    """Where a person's files may be: beside the volumes as they are now, else `folder_of`."""
    volume = next((thing.data for thing in collection.all_objects if thing.type == "VOLUME"), None)
    beside = [volume_path(volume).parent] if volume is not None and volume.filepath else []
    return [*beside, folder_of(collection)]


def person_file_name(collection: bpy.types.Collection) -> str:
    """The name of `person_file`, which is another one after each edit."""
    return str(collection.get(PERSON, PERSON_FILE))


def volume_path(volume: bpy.types.Volume) -> Path:
    """The absolute path of a volume's file."""
    return Path(bpy.path.abspath(volume.filepath, library=volume.library))


def overlap_warning(collection: bpy.types.Collection) -> str | None:
    """A sentence for the user when Cycles will drop volumes of this person, else None."""
    most = int(json.loads(collection[MARK])["most_overlapping"])
    if most <= CYCLES_LIMIT:
        return None
    return (
        f"up to {most} volumes of {collection.name!r} overlap at a point and Cycles draws only {CYCLES_LIMIT}; "
        "render it with the exact marcher"
    )


def armature_of(collection: bpy.types.Collection) -> bpy.types.Object:
    """The person's armature object; ValueError when the collection is no person or lost it."""
    for candidate in collection.objects:
        if MARK in collection and candidate.type == "ARMATURE":
            return candidate
    raise ValueError(f"the collection {collection.name!r} holds no generated person; select one that does")


def humans(scene: bpy.types.Scene) -> list[bpy.types.Collection]:
    """The people of a scene."""
    return [collection for collection in scene.collection.children_recursive if MARK in collection]


def human_of(thing: bpy.types.Object | None, scene: bpy.types.Scene) -> bpy.types.Collection | None:
    """The person that an object is a part of, hangs on (a hat parented to a bone), or instances; None for others."""
    while thing is not None:
        around = set(thing.users_collection)
        for collection in humans(scene):
            if not around.isdisjoint([collection, *collection.children_recursive]):
                return collection
        if thing.instance_collection is not None and MARK in thing.instance_collection:
            return thing.instance_collection
        thing = thing.parent
    return None


def people_files() -> set[str]:
    """Names of the backend's files that people of this .blend use, those linked included."""
    return {person_file_name(collection) for collection in bpy.data.collections if MARK in collection}


def remove_human(collection: bpy.types.Collection) -> None:
    """Take a person out of the .blend: objects, their data and the actions only they use.

    The VDB files stay, so that an undo of the removal, or an older copy of the .blend, finds them.
    """
    objects = list(collection.all_objects)
    data = [thing.data for thing in objects if thing.data is not None]
    actions = [thing.animation_data.action for thing in objects if thing.animation_data and thing.animation_data.action]
    bpy.data.batch_remove([*objects, *collection.children_recursive, collection])
    bpy.data.batch_remove([thing for thing in {*data, *actions} if thing.users == 0])


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
