"""Every name and path that the extension reads from a .blend or the preferences, each with values of an attacker.

`attempt` saves, loads, draws all panels and runs the operators on files, and tells what was changed outside of the
folder beside the .blend.
"""

import contextlib
import io
import json
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import bpy
import synthetic_shape

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import sidebar

from blender_primdiffusion.places import EXTENSION
from blender_primdiffusion.scene import cells, merged, proxy, representation, splats, volume_nodes
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.edit import replace_person
from blender_primdiffusion.scene.human import (
    BETAS,
    BODY,
    BODY_MARK,
    MARK,
    ORIGIN,
    PAYLOAD,
    body_of,
    is_human,
    link_part,
    parts_of,
)
from blender_primdiffusion.scene.volume_nodes import open_humans, write_volumes

COUNT = 3
"""Volumes of the human."""
SECRET = b"a user's file"
LINK, DEVICE = "prim_0000.vdb", "prim_0001.vdb"
"""Names, among the stranger's files, of links to a user's file and to a device."""
LONGEST_SENTENCE = 400
_LONGEST_LABEL, _LONGEST_PATH = 1000, 1024


class Stage:
    """The folders of one attempt.

    `home/.bashrc` is the user's; `home/me/project/shot.blend` is the stranger's file, saved by the user;
    `downloads/zip` has files that its volumes name.
    """

    def __init__(self, root: Path):
        self.root = root
        self.users = root / "home" / ".bashrc"
        self.project = root / "home" / "me" / "project"
        self.blend = self.project / "shot.blend"
        self.volumes = self.project / "shot_volumes"
        self.source = root.with_name("source")
        """Files of the human as the backend would write them."""
        self.shipped = root / "downloads" / "zip"

    def before(self) -> dict[Path, bytes]:
        """All files with their content; links with where they lead."""
        files = [path for path in sorted(self.root.rglob("*")) if path.is_symlink() or path.is_file()]
        return {path: os.readlink(path).encode() if path.is_symlink() else path.read_bytes() for path in files}

    def changed_outside(self, before: dict[Path, bytes]) -> list[str]:
        """Files outside of the folder beside the .blend that are new, gone or different; in it, those that were there
        and are gone or different, and copies of the user's file."""
        after, found = self.before(), []
        for path in sorted({*before, *after}):
            inside = path.is_relative_to(self.volumes)
            allowed = path.name.startswith("shot.blend") or (inside and path not in before)
            if not allowed and before.get(path) != after.get(path):
                found.append(f"{path.relative_to(self.root)} changed")
            if inside and path not in before and SECRET in after.get(path, b""):
                found.append(f"{path.relative_to(self.root)} is a copy of the user's file")
        return found


def build(stage: Stage) -> None:
    """Make the stage's folders: a human with all that can be stored with one, whose files are the stranger's."""
    stage.project.mkdir(parents=True)
    stage.shipped.mkdir(parents=True)
    stage.users.write_bytes(SECRET)
    (stage.root / "downloads" / ".bashrc").write_bytes(b"the stranger's")
    first = stage.source
    first.mkdir()
    (first / "grid.vdb").write_bytes(b"merged")
    synthetic_shape.write(first, COUNT)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(stage.blend))
    person = build_human(bpy.context, first / "person.human.safetensors", "Anna")
    armature = person
    bpy.context.view_layer.objects.active = armature
    armature.animation_data_create().action = bpy.data.actions.new("Walk")
    mesh = bpy.data.objects.new("Anna_proxy", body_of(person).data.copy())
    mesh[proxy.PROXY_MARK] = json.dumps({"file": "person.human.safetensors", "betas": [0.0] * 10})
    mesh.parent = person
    link_part(person, mesh)
    whole = bpy.data.objects.new("Anna_merged", bpy.data.volumes.new("Anna_merged"))
    whole[merged.MARK] = json.dumps({"poses": ["0"], "voxel": 0.01, "start": 0})
    whole.data.filepath = str(stage.shipped / "merged_0123456789ab.vdb")
    whole.parent = person
    link_part(person, whole)
    cloud = bpy.data.objects.new("Anna_splats", bpy.data.pointclouds.new("Anna_splats"))
    cells = bpy.data.objects.new("Anna_cells", body_of(person).data.copy())
    cloud[splats.SPLATS_MARK] = cells[splats.CELLS_MARK] = True
    for part in (cloud, cells):
        part.parent = person
        link_part(person, part)
    (stage.shipped / "merged_0123456789ab.vdb").write_bytes(b"merged")
    (stage.shipped / LINK).symlink_to(os.path.relpath(stage.users, stage.shipped))
    (stage.shipped / DEVICE).symlink_to("/dev/zero")
    for volume in bpy.data.volumes:  # relative, so that copies of the stage hold together
        volume.filepath = bpy.path.relpath(str(stage.shipped / Path(volume.filepath).name))
    bpy.ops.wm.save_mainfile()
    shutil.copy(stage.blend, stage.blend.with_name("other.blend"))


def person() -> bpy.types.Object:
    return next(filter(is_human, bpy.data.objects))


def _with(mark: str) -> Callable[[], bpy.types.Object]:
    return lambda: next(obj for obj in parts_of(person()) if mark in obj)


HOLDERS: dict[str, Callable[[], Any]] = {
    **dict.fromkeys((MARK, representation.REPRESENTATION, representation.IN_VIEWPORT), person),
    **dict.fromkeys((BETAS, PAYLOAD, BODY), person),
    ORIGIN: lambda: person().data,
    BODY_MARK: lambda: body_of(person()),
    proxy.PROXY_MARK: _with(proxy.PROXY_MARK),
    merged.MARK: _with(merged.MARK),
    volume_nodes.VOLUMES_MARK: _with(volume_nodes.VOLUMES_MARK),
    splats.SPLATS_MARK: _with(splats.SPLATS_MARK),
    splats.CELLS_MARK: _with(splats.CELLS_MARK),
}
"""What holds each custom property."""
SETTINGS = {
    "primdiffusion_captures": ("people", "out", "body", "poses", "hdri"),
    "primdiffusion_picture": ("mask",),
}
"""Paths among the scene's settings."""
PREFERENCES = ("backend_python", "checkpoint")
"""Paths in the preferences."""


def _set_setting(group: str, name: str) -> Callable[[object], None]:
    def put(value: object) -> None:
        settings = getattr(bpy.context.scene, group)
        if isinstance(value, str):
            setattr(settings, name, value)
            return
        scene = bpy.context.scene  # as a .blend may store it, of another type than the property's
        stored = scene.bl_system_properties_get(do_create=True) if hasattr(scene, "bl_system_properties_get") else scene
        settings.property_unset(name)
        if group not in stored:
            stored[group] = {}
        stored[group][name] = value

    return put


def _set_preference(name: str) -> Callable[[object], None]:
    return lambda value: setattr(bpy.context.preferences.addons[EXTENSION].preferences, name, value)


def _set_custom(name: str) -> Callable[[object], None]:
    def put(value: object) -> None:
        holder = HOLDERS[name]()
        if name in holder:  # of another type
            del holder[name]
        holder[name] = value

    return put


def _set_folder(value: object) -> None:
    modifier = volume_nodes.volumes_of(person()).modifiers[volume_nodes.MODIFIER]
    cells.set_input(modifier, volume_nodes.FOLDER, value)


def _set_library(value: object) -> None:
    other = Path(bpy.data.filepath).with_name("other.blend")
    with bpy.data.libraries.load(str(other), link=True) as (_, wanted):
        wanted.collections = ["Anna"]
    bpy.context.scene.collection.children.link(wanted.collections[0])
    bpy.data.libraries[0].filepath = value


PROPERTIES: dict[str, Callable[[object], None]] = {
    **{name: _set_custom(name) for name in HOLDERS},
    "volumes.folder": _set_folder,
    "merged.filepath": lambda value: setattr(bpy.data.volumes["Anna_merged"], "filepath", value),
    "library.filepath": _set_library,
    "armature.name": lambda value: setattr(person(), "name", value),
    **{f"{group}.{name}": _set_setting(group, name) for group, names in SETTINGS.items() for name in names},
    **{f"preferences.{name}": _set_preference(name) for name in PREFERENCES},
}
"""How each is set, as a stranger would."""
TEXT_ONLY = {"volumes.folder", "merged.filepath", "library.filepath", "armature.name"} | {
    f"preferences.{name}" for name in PREFERENCES
}
"""Blender itself stores these as text."""
ODD_RECORD = {
    "betas": "x", "edits": [1, {"edit": {}}, {"a\ud800": "\ud800"}], "attributes": [1], "seed": {"a": 1}, "steps": "\0",
    "file": 1, "poses": [], "voxel": "x", "start": None, "checkpoint": ["x"],
}  # fmt: skip


def values(name: str, stage: Stage) -> dict[str, object]:
    """What is stored in a property, by what it is."""
    texts = {
        "up": "../../../.bashrc",
        "up from the file": "//../../.bashrc",
        "volume in a parent": f"{stage.shipped}/../prim_0000.vdb",
        "absolute": str(stage.users),
        "server": r"\\host\share\x",
        "link": str(stage.shipped / LINK),
        "link to a device": str(stage.shipped / DEVICE),
        "device": "/dev/zero",
        "empty": "",
        "control characters": "a\n\x1b[2Jb",
        "long": "x" * 2**20,
        "long parts": "/".join(["", "p" * 300, "q" * 300, "prim_0000.vdb"]),
        "deep": "[" * 100_000,
        "odd record": json.dumps(ODD_RECORD),
        "long record": json.dumps({"seed": "x" * 2**20, "attributes": {f"n{k}": k for k in range(1000)}}),
        "large numbers": json.dumps({"betas": [1e300] * 10, "poses": [1] * 9, "voxel": 1}),
    }
    if name in TEXT_ONLY:
        return dict(texts)
    others = {"number": 7, "numbers": [0.5] * 3, "group": {"a": {"b": 1}}, "bytes": b"\xff\x00"}
    return {**texts, **others}


def panels_fault() -> str:
    """Which panel cannot be drawn, or draws what Blender cannot show; empty when all can."""
    menus = [cls for cls in bpy.types.Menu.__subclasses__() if cls.__name__.startswith("PRIMDIFFUSION_MT_")]
    for cls in [*sidebar.panels(), *menus]:
        try:
            shown = not hasattr(cls, "poll") or cls.poll(bpy.context) or cls.__name__ == "PRIMDIFFUSION_PT_captures"
            if not shown:
                continue
            texts = sidebar.draw(cls, bpy.context, opened=True).texts
        except Exception as error:
            return f"{cls.__name__} raises {error!r:.200}"
        for text in texts:
            if len(text) > _LONGEST_LABEL or any(0xD800 <= ord(letter) < 0xE000 for letter in text):
                return f"{cls.__name__} shows {text!r:.80}"
    return ""


OPERATORS: tuple[tuple[str, dict[str, object]], ...] = (
    ("set_representation", {"representation": "VOLUMES"}), ("reshape", {"to": "GENERATED"}),
    ("set_representation", {"representation": "NO_MESH"}), ("merge", {"what": "NOTHING"}),
)  # fmt: skip
"""Pressed one after the other; those that need the backend are what `edit_fault` does with its result."""


def operators_fault() -> str:
    """Which operator ends in more than a sentence; empty when none does."""
    for name, properties in OPERATORS:
        try:
            getattr(bpy.ops.primdiffusion, name)(**properties)
        except RuntimeError as error:
            text = str(error).strip()
            longest = max(map(len, text.splitlines()), default=0)
            if "Traceback" in text or longest > LONGEST_SENTENCE + _LONGEST_PATH:
                return f"{name}: {text[-800:]!r}"
    return ""


def edit_fault(stage: Stage, source: Path) -> str:
    """What goes wrong when an edit's result and a merged volume enter the scene; empty when nothing does."""
    try:
        replace_person(person(), source / "person.human.safetensors")
        merged.publish([source / "grid.vdb"], ["a"], merged.merged_folder())
        write_volumes(person())
    except (ValueError, OSError):
        return ""
    except Exception as error:
        return f"an edit raises {error!r:.300}"
    return ""


def saving_fault() -> str:
    """What goes wrong when the file is saved and looked through; empty when nothing does."""
    with contextlib.redirect_stderr(io.StringIO()) as errors:
        try:
            bpy.ops.wm.save_mainfile()
            open_humans()
        except Exception as error:
            return f"saving raises {error!r:.300}"
    return f"saving prints {errors.getvalue()[-800:]}" if "Traceback" in errors.getvalue() else ""


def attempt(name: str, value: object, stage: Stage, source: Path) -> list[str]:
    """What one value of one property does that it must not; `stage` is used up."""
    bpy.ops.wm.open_mainfile(filepath=str(stage.blend))
    settings = bpy.context.scene.primdiffusion_captures
    settings.people = settings.out = ""
    before = stage.before()
    PROPERTIES[name](value)
    faults = [
        panels_fault(),
        saving_fault(),
        operators_fault(),
        panels_fault(),
        edit_fault(stage, source),
        panels_fault(),
        saving_fault(),
    ]
    return [*filter(None, faults), *stage.changed_outside(before)]


def tried(name: str, pristine: Stage, folder: Path, every: int = 1) -> Iterator[tuple[str, list[str]]]:
    """Each value of a property, and what it did; in copies of `pristine` at `folder`, which is removed each time.

    Of every so many values one, so that the properties together are tried with all."""
    for what in list(values(name, pristine))[list(PROPERTIES).index(name) % every :: every]:
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(pristine.root, folder, symlinks=True)
        stage = Stage(folder)
        yield what, attempt(name, values(name, stage)[what], stage, pristine.source)
    shutil.rmtree(folder, ignore_errors=True)


@contextlib.contextmanager
def in_preferences() -> Iterator[None]:
    """The extension among the enabled ones, so that it has preferences."""
    addons = bpy.context.preferences.addons
    made = addons.get(EXTENSION) or addons.new()
    made.module = EXTENSION
    try:
        yield
    finally:
        addons.remove(addons.get(EXTENSION))
