"""Settings to generate humans with: seed, quality, and the attributes that the checkpoint knows, Any by default.

The backend writes the attributes into the checkpoint's metadata, which are read without torch.
"""

from __future__ import annotations

import contextlib
import dataclasses
import random
import re
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import bpy

from ..files.json_files import parse_json
from ..files.regular_files import as_file_error, is_local_path, open_regular
from ..files.tensor_layout import read_layout
from ..formats.requests import SAMPLERS, GenerateRequest
from ..places import backend_module_path, preference
from .declared import SKIP, declared

_LARGEST_FILE = 16 << 30
"""Bytes, as in the backend's `tensor_file`."""
_LONGEST_TEXT = 1 << 16
"""Characters of a model's settings; those of the default one have a thousand."""
_LARGEST_NUMBER = 1e9
ANY = "ANY"
CATEGORIES = ("sex", "outfit", "pattern", "shoes", "hair", "hat")
"""Attributes with a menu."""
SCALARS = {"height": "m", "weight": "kg"}
_DEFAULT_CHECKPOINT = Path("primdiffusion", "weights", "default.safetensors")

Attributes = dict[str, str | float]
Item = tuple[str, str, str, int]

_read: dict[Path, tuple[float, Vocabulary]] = {}
"""By path, with the modification time of the file."""
_items: dict[tuple[str, ...], list[Item]] = {}
"""Holds the strings of dynamic menus, to which Blender holds no references."""


@dataclasses.dataclass(frozen=True)
class Vocabulary:
    """Attributes that a model knows; none for one that was trained without."""

    categories: Mapping[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)
    """Name -> values to choose from: sex, outfit, hair."""
    scalars: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    """Name -> mean and standard deviation: height in metres, weight in kilograms."""


def read_vocabulary(path: Path) -> Vocabulary:
    """The vocabulary of a checkpoint; an empty one where the file has none.

    Raises OSError for a file that cannot be read and ValueError for one that is not a checkpoint.
    """
    with as_file_error(path, "is damaged or no checkpoint of a diffusion model", "choose another file"):
        with open_regular(path, _LARGEST_FILE) as file:
            layout = read_layout(file)
        text = layout.metadata["architecture"]
        if len(text) > _LONGEST_TEXT:
            raise ValueError(f"its architecture has {len(text)} characters, and {_LONGEST_TEXT} are the most")
        tree = parse_json(text).get("vocabulary") or {}
        categories = {name: tuple(map(str, values)) for name, values in tree.get("categories", {}).items()}
        scalars = {name: (float(mean), float(std)) for name, (mean, std) in tree.get("scalars", {}).items()}
        if not all(abs(mean) <= _LARGEST_NUMBER and 0 < std <= _LARGEST_NUMBER for mean, std in scalars.values()):
            raise ValueError("a mean or standard deviation that no quantity has")
    return Vocabulary(categories, scalars)


def known() -> Vocabulary:
    """The vocabulary of the current checkpoint; empty where it cannot be read, which generating reports."""
    chosen, bundled = preference("checkpoint"), backend_module_path()
    if chosen:
        if not is_local_path(chosen):
            return Vocabulary()
        path = Path(chosen)
    elif bundled is not None:
        path = bundled / _DEFAULT_CHECKPOINT
    else:
        return Vocabulary()
    try:
        time = path.stat().st_mtime
    except (OSError, ValueError):
        return Vocabulary()
    if path not in _read or _read[path][0] != time:
        found = Vocabulary()  # a damaged file is read once, too: panels ask at each draw
        with contextlib.suppress(OSError, ValueError):
            found = read_vocabulary(path)
        _read[path] = (time, found)
    return _read[path][1]


def menu(name: str) -> list[Item]:
    """The items of the menu of a category. Their numbers, which a .blend saves, depend only on the value, so that other
    checkpoints with the same value show it."""
    values = known().categories.get(name, ())
    if values not in _items:
        numbered = [(value, choice_label(value), "", zlib.crc32(value.encode()) & 0x7FFFFFFF or 1) for value in values]
        _items[values] = [(ANY, "Any", "No preference", 0), *numbered]
    return _items[values]


def choice_label(value: str) -> str:
    """Label of a value: side parting -> Side parting, shoes01 -> Shoes 1."""
    spaced = re.sub(r"(?<=[a-z])0*(\d+)$", r" \1", value)
    return spaced[:1].upper() + spaced[1:]


def title(name: str) -> str:
    """Label of an attribute or a part."""
    return name.replace("_", " ").title()


def _menu_property(name: str):
    items: Callable = lambda _self, _context: menu(name)  # noqa: E731  bpy wants a function of its own for each
    return bpy.props.EnumProperty(name=title(name), description="Attribute of the generated human", items=items)


class PRIMDIFFUSION_PG_attributes(bpy.types.PropertyGroup):
    """Attributes to generate a human with; none unless chosen."""

    __slots__ = ()
    sex: _menu_property("sex")
    outfit: _menu_property("outfit")
    pattern: _menu_property("pattern")
    shoes: _menu_property("shoes")
    hair: _menu_property("hair")
    hat: _menu_property("hat")
    use_height: bpy.props.BoolProperty(name="Use Height", description="Generate a body of this height")
    height: bpy.props.FloatProperty(
        name="Height (m)", description="Metres; no effect without Use Height", default=1.7, min=0.5, max=2.5, step=1
    )
    use_weight: bpy.props.BoolProperty(name="Use Weight", description="Generate a body of this weight")
    weight: bpy.props.FloatProperty(
        name="Weight (kg)", description="Kilograms; no effect without Use Weight", default=70, min=10, max=300, step=100
    )


def chosen_attributes(group: PRIMDIFFUSION_PG_attributes) -> Attributes:
    """The chosen attributes that the checkpoint knows, as parameters of the child."""
    vocabulary = known()
    chosen: Attributes = {}
    for name in CATEGORIES:
        if name in vocabulary.categories and getattr(group, name) not in (ANY, ""):
            chosen[name] = getattr(group, name)
    for name in SCALARS:
        if name in vocabulary.scalars and getattr(group, f"use_{name}"):
            chosen[name] = round(getattr(group, name), 4)
    return chosen


def draw_attributes(layout: bpy.types.UILayout, group: PRIMDIFFUSION_PG_attributes) -> None:
    """Menus and fields of the attributes that the checkpoint knows."""
    vocabulary = known()
    for name in CATEGORIES:
        if name in vocabulary.categories:
            layout.prop(group, name)
    for name in SCALARS:
        if name in vocabulary.scalars:
            row = layout.row(align=True, heading=group.bl_rna.properties[name].name)
            row.prop(group, f"use_{name}", text="")
            number = row.row()
            number.enabled = getattr(group, f"use_{name}")
            number.prop(group, name, text="")
    if not (vocabulary.categories or vocabulary.scalars):
        layout.label(text="This checkpoint has no attributes", icon="INFO")


LARGEST_SEED = 2**31 - 1
"""The backend itself takes seeds up to 2^63 - 1."""


def random_seed() -> int:
    """A random seed."""
    return random.randrange(LARGEST_SEED + 1)


def last_seed(seed: int, count: int) -> int:
    """The last of `count` consecutive seeds. Raises ValueError beyond LARGEST_SEED."""
    last = seed + count - 1
    if last > LARGEST_SEED:
        raise ValueError(f"{count} seeds from {seed} on go beyond {LARGEST_SEED}: choose a smaller seed")
    return last


STEPS_AND_SAMPLER = {"DRAFT": (8, "dpmpp_2m"), "STANDARD": (20, "dpmpp_2m"), "HIGH": (60, "dpmpp_2m")}
CUSTOM = "CUSTOM"
ITEMS = [
    ("DRAFT", "Draft", "8 steps of DPM-Solver++: quick and softer; the same seed sometimes gives another human"),
    ("STANDARD", "Standard", "20 steps of DPM-Solver++"),
    ("HIGH", "High", "60 steps of DPM-Solver++: three times the time of Standard for a little more detail"),
    (CUSTOM, "Custom", "Steps and sampler as chosen below"),
]


def apply_quality(settings: bpy.types.PropertyGroup, _context: bpy.types.Context) -> None:
    """Steps and sampler of the chosen quality. The update function of `quality`."""
    if settings.quality != CUSTOM and quality_of(settings) != settings.quality:
        settings.steps, settings.sampler = STEPS_AND_SAMPLER[settings.quality]


def name_quality(settings: bpy.types.PropertyGroup, _context: bpy.types.Context) -> None:
    """The quality with these steps and this sampler. The update function of both."""
    if settings.quality != quality_of(settings):
        settings.quality = quality_of(settings)


def quality_of(settings: bpy.types.PropertyGroup) -> str:
    """The quality with these steps and this sampler, else CUSTOM."""
    chosen = (settings.steps, settings.sampler)
    return next((name for name, both in STEPS_AND_SAMPLER.items() if both == chosen), CUSTOM)


_SAMPLERS = {
    "ddim": ("DDIM", "First-order, as in the paper's code: needs more steps"),
    "dpmpp_2m": ("DPM-Solver++(2M)", "Second-order multistep: good with few steps"),
    "ddpm": ("DDPM", "New noise at each step; needs many steps"),
}
SAMPLER_ITEMS = [(name, *_SAMPLERS[name]) for name in SAMPLERS]
SAMPLER_NAMES = {name: label for name, label, _ in SAMPLER_ITEMS}


class PRIMDIFFUSION_PG_settings(bpy.types.PropertyGroup):
    """`scene.primdiffusion`."""

    __slots__ = ()
    seed: declared(GenerateRequest, "seed", default=10)
    keep_seed: bpy.props.BoolProperty(
        name="Lock Seed", description="Keep the seed; otherwise it is set to a new random one after each human"
    )
    count: bpy.props.IntProperty(
        name="Count",
        description="How many humans: from this seed and the following ones, placed side by side",
        default=1,
        min=1,
        max=1000,
        soft_max=20,
    )
    quality: bpy.props.EnumProperty(
        name="Quality",
        description="Steps and sampler",
        items=ITEMS,
        default="STANDARD",
        update=apply_quality,
    )
    steps: declared(GenerateRequest, "steps", update=name_quality)
    sampler: bpy.props.EnumProperty(
        name="Sampler", description="How the noise is removed", items=SAMPLER_ITEMS, update=name_quality
    )
    guidance: declared(GenerateRequest, "guidance")
    attributes: bpy.props.PointerProperty(type=PRIMDIFFUSION_PG_attributes)


def seed_property():
    """The seed of an operator, for scripts."""
    return declared(GenerateRequest, "seed", default=-1, min=-1, description="-1: the panel's seed", options=SKIP)


def sampling(settings: bpy.types.PropertyGroup) -> dict[str, Any]:
    """Fields of `GenerateRequest` besides the seed."""
    wanted = chosen_attributes(settings.attributes)
    fields = {name: getattr(settings, name) for name in ("steps", "sampler", "guidance")}
    return fields | ({"attributes": wanted} if wanted else {})


PROPERTIES = ((bpy.types.Scene, "primdiffusion", bpy.props.PointerProperty(type=PRIMDIFFUSION_PG_settings)),)
