"""scripts/window plays in a real window, which no test opens: what it names must at least be there."""

import re
import sys
from importlib import import_module
from pathlib import Path

import bpy
import pytest

ROOT = Path(__file__).resolve().parents[2]
SCENES = ROOT / "scripts" / "window"
PACKAGE = "blender_primdiffusion"
sys.path.append(str(SCENES))

pytestmark = pytest.mark.any_blender


def found(pattern: str) -> set[tuple[str, ...]]:
    texts = (path.read_text(encoding="utf-8") for path in SCENES.glob("*.py"))
    return {match.groups() for text in texts for match in re.finditer(pattern, text)}


def test_scenes_name_modules_operators_and_panels_that_exist(addon):
    used = found(r'import_module\(f"\{[\w.]+\}\.([\w.]+)"\)\.(\w+)')
    assert len(used) > 5
    assert not [name for name in used if not hasattr(import_module(f"{PACKAGE}.{name[0]}"), name[1])]
    registered = found(r'"primdiffusion\.(\w+)"')
    assert not [name for (name,) in registered if not hasattr(bpy.types, f"PRIMDIFFUSION_OT_{name}")]
    panels = found(r'"(PRIMDIFFUSION_PT_\w+)[/"]')
    assert not [name for (name,) in panels if not hasattr(bpy.types, name)]
