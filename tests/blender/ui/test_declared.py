"""Properties have the limits, defaults and descriptions of the requests that they are sent with."""

import bpy
import pytest
from blender_primdiffusion.formats.schema import Range, Slider, descriptions, field_types, split

from blender_primdiffusion.capture.settings import CaptureSettings
from blender_primdiffusion.formats import requests

pytestmark = pytest.mark.any_blender

LARGEST = 2**31 - 1
SETTINGS = {
    "primdiffusion": (requests.GenerateRequest, ("steps", "guidance", "seed")),
    "primdiffusion_edit": (requests.VaryRequest, ("amount", "seed")),
    "primdiffusion_export": (requests.ProxyRequest, ("triangles",)),
    "primdiffusion_captures": (CaptureSettings, ("pose_count", "samples", "seed")),
}


@pytest.mark.parametrize(
    ("group", "field"), [(group, field) for group, (_, names) in SETTINGS.items() for field in names]
)
def test_a_setting_has_the_limits_of_its_request(addon, group, field):
    record = SETTINGS[group][0]
    shown = getattr(addon.scene, group).bl_rna.properties[field]
    _, marks = split(field_types(record)[field])
    limits = next(mark for mark in marks if isinstance(mark, Range))
    assert (shown.hard_min, shown.hard_max) == (limits.least, min(limits.most, LARGEST))
    for slider in (mark for mark in marks if isinstance(mark, Slider)):
        assert (shown.soft_min, shown.soft_max) == (slider.least, slider.most)
    assert shown.description == descriptions(record)[field].rstrip(".")
    if field != "seed":  # which the panel begins with is its own affair
        assert shown.default == pytest.approx(getattr(record, field))


def test_a_misspelt_setting_is_an_error(addon):
    groups = [name for name in dir(bpy.types.Scene) if name.startswith("primdiffusion")]
    assert {*SETTINGS} < {*groups}
    for group in groups:
        settings = getattr(addon.scene, group)
        if isinstance(settings, bpy.types.PropertyGroup):
            with pytest.raises(AttributeError):
                settings.atrributes = ""


def test_a_choice_and_a_file_are_those_of_the_record(addon):
    shown = addon.scene.primdiffusion_captures.bl_rna.properties
    assert [(item.identifier, item.name) for item in shown["light"].enum_items] == [
        ("uniform", "Uniform"), ("dome", "Dome"), ("hdri", "HDRI")
    ]  # fmt: skip
    assert shown["light"].default == CaptureSettings.light
    assert (shown["body"].subtype, shown["body"].default) == ("FILE_PATH", "")


def test_an_operator_has_the_limits_of_its_request(addon):
    for name, record, field in (
        ("generate", requests.GenerateRequest, "seed"),
        ("vary", requests.VaryRequest, "seed"),
    ):
        shown = getattr(bpy.ops.primdiffusion, name).get_rna_type().properties[field]
        limits = next(mark for mark in split(field_types(record)[field])[1] if isinstance(mark, Range))
        assert (shown.hard_min, shown.hard_max) == (-1, min(limits.most, LARGEST))
        assert shown.is_skip_save
