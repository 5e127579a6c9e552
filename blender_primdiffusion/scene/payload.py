"""A human's own file, as the backend has saved it, packed in the .blend: an image that the armature holds.

Blender copies, appends, links, overrides, undoes and saves it with the armature. Readers get it as a file of the
session, written once to Blender's temporary folder, in a folder that is named by the content. The child reads it there,
and the volumes for Cycles are written beside it. An edit packs another image.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import bpy

from ..files.regular_files import read_regular, remove_folder
from ..files.whole_files import written_whole
from .blend_values import stored_image

PAYLOAD = "primdiffusion"
"""Custom property of a human's armature: the image in which its file is packed."""
BODY = "primdiffusion_body_file"
"""Custom property of the armature of a human on a body of the user's files: the image with the body's file."""
PERSON_FILE = "person.human.safetensors"
"""The name that the backend gives to a human's file."""
BODY_FILE = "body.safetensors"
"""The name of the body's file, beside PERSON_FILE."""
LARGEST_PERSON = 256 << 20
"""Largest file of a human or a body, bytes."""
_FILES = {BODY: BODY_FILE, PAYLOAD: PERSON_FILE}
_digests: dict[tuple[int, int, int], str] = {}
"""Digests of packed files, by the image's identity, size and address."""


def session_folder() -> Path:
    """The folder, among Blender's temporary files, of the files of this session."""
    return Path(bpy.app.tempdir) / "primdiffusion_humans"


def pack(armature: bpy.types.Object, person: Path, *, own_body: bool) -> None:
    """Have an armature hold a human's file, and with `own_body` that of the body beside it; replaces those before.

    Raises ValueError for a file that is too large or not a regular one, OSError.
    """
    files = {PAYLOAD: read_regular(person, LARGEST_PERSON)}
    if own_body:
        files[BODY] = read_regular(person.with_name(BODY_FILE), LARGEST_PERSON)
    for name in _FILES:
        before = stored_image(armature, name, LARGEST_PERSON)
        if name in armature:
            del armature[name]
        if name in files:
            armature[name] = _packed(armature.name, files[name])
        if before is not None and before.users == 0 and before.library is None:
            bpy.data.images.remove(before)


def session_file(armature: bpy.types.Object) -> Path:
    """The human's own file on the disk, with its body's beside it, both from the .blend.

    Raises ValueError for an armature without one, OSError where the temporary folder cannot be written.
    """
    folder = session_folder() / state_of(armature)
    if stored_image(armature, PAYLOAD, LARGEST_PERSON) is None:
        raise ValueError(
            f"{armature.name!r} holds no data of a human, as in files of earlier versions: generate the human again, "
            "or import its .human file"
        )
    for name, file in _FILES.items():
        image = stored_image(armature, name, LARGEST_PERSON)
        if image is not None and not (folder / file).is_file():
            folder.mkdir(parents=True, exist_ok=True)
            with written_whole(folder / file) as unfinished:
                unfinished.write_bytes(image.packed_file.data)
    return folder / PERSON_FILE


def state_of(armature: bpy.types.Object) -> str:
    """Identifies what an armature holds, by its content: an edit changes it, undo switches it back."""
    images = (stored_image(armature, name, LARGEST_PERSON) for name in _FILES)
    return "_".join(_digest(image) for image in images if image is not None)


def forget_session_files() -> None:
    """Remove the files of this session; those that are needed again are written again."""
    remove_folder(session_folder(), session_folder().parent)


def _packed(name: str, data: bytes) -> bpy.types.Image:
    """An image that holds these bytes: one that is there already, else a new one."""
    digest = _sha256(data)
    for image in bpy.data.images:
        packed = image.packed_file if image.library is None else None
        if packed is not None and packed.size == len(data) and _digest(image) == digest:
            return image
    image = bpy.data.images.new(name, 1, 1)
    image.source = "FILE"
    image.pack(data=data, data_len=len(data))
    return image


def _digest(image: bpy.types.Image) -> str:
    key = (image.session_uid, image.packed_file.size, image.packed_file.as_pointer())
    if key not in _digests:
        _digests[key] = _sha256(image.packed_file.data)
    return _digests[key]


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:24]
