"""A person comes to be: from human.npz to one collection in the scene."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import bpy

from . import volumes
from .armature import build_armature
from .attach import attach_volumes
from .beforehand import Baked, Written, bake
from .body_mesh import build_body_mesh
from .convention import frames_to_blender, points_to_blender
from .folders import humans_folder
from .grid_cache import read_headers
from .human import BETAS, HOME, MARK, PERSON, folder_of, volume_path
from .material import volume_material
from .placing_files import free_name
from .shape_file import body_kept

_NAME_LENGTH = 40
_ABOUT_BETAS = "Shape of the body. The sliders in the sidebar set it; keys and drivers move the engine's picture alone"
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
    person = _build(context, bake(human_npz), None, name, keep)
    read_headers(volume_path(thing.data) for thing in person.all_objects if thing.type == "VOLUME")
    return person


def build_written(
    context: bpy.types.Context, written: Written, name: str = "Human", keep: Sequence[Path] = ()
) -> bpy.types.Collection:
    """As `build_human`, quickly, of a person whose volumes are written: where they are, or, if somebody else has taken
    that place meanwhile, as copies elsewhere."""
    with written.entering(lambda: folder_of(person)):
        person = _build(context, written.baked, written, name, keep)
    return person


def home_of_next(name: str) -> Path:
    """`folder_of` the person who is built under this name next, as far as can be told: Blender numbers names."""
    name = name[:_NAME_LENGTH]
    taken = {collection.name for collection in bpy.data.collections if collection.library is None}
    numbered = (f"{name}.{number:03d}" for number in itertools.count(1))
    free = name if name not in taken else next(one for one in numbered if one not in taken)
    return humans_folder() / bpy.path.clean_name(free)


def _build(
    context: bpy.types.Context, baked: Baked, written: Written | None, name: str, keep: Sequence[Path]
) -> bpy.types.Collection:
    human = baked.human
    with _nothing_left_on_failure():
        collection = bpy.data.collections.new(name[:_NAME_LENGTH])
        label = collection.name
        armature = build_armature(label, points_to_blender(human.joints))
        armature[BETAS] = human.betas.tolist()
        armature.id_properties_ui(BETAS).update(description=_ABOUT_BETAS)
        collection.objects.link(armature)
        vertices = points_to_blender(human.vertices)
        armature.location = (0.0, 0.0, -vertices[:, 2].min())
        body = build_body_mesh(f"{label}_body", armature, vertices, human.faces, human.uv_corner, human.skin_weights)
        collection.objects.link(body)
        primitives = bpy.data.collections.new(f"{label}_primitives")
        collection.children.link(primitives)
        home = folder_of(collection)
        kept = {free_name(path, home, path.name): path for path in keep}
        with (
            _volumes(baked, written, home, kept) as files,
            body_kept(collection, human.shape_model, home.parent),
        ):
            attach_volumes(
                label,
                armature,
                primitives,
                files,
                points_to_blender(human.position),
                frames_to_blender(human.rotation),
                human.primitive_weights,
                volume_material(),
            )
            collection[MARK] = baked.provenance
            collection[HOME] = str(home)
            for name, path in kept.items():
                if name != path.name:  # the usual name is taken by somebody who was deleted
                    collection[PERSON] = name
            context.scene.collection.children.link(collection)
    return collection


@contextmanager
def _volumes(baked: Baked, written: Written | None, home: Path, kept: dict[str, Path]) -> Iterator[Sequence[Path]]:
    """The files of the volumes in `home`, with `kept` beside them where the block ends well."""
    if written is None:
        with volumes.written(baked.grids, home, kept) as files:
            yield files
        return
    here = written.home == home
    copies = {} if here else {path.name: path for path in written.files}
    with volumes.written(baked.grids, home, {**kept, **copies}, which=[]):
        yield written.files if here else [home / name for name in copies]


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
