"""Run by test_blender_application in Blender: enabled, registered twice, disabled, thrice; says what stays.

blender -b --python application_life.py -- REPORT.json
"""

import json
import sys
from pathlib import Path

import bpy

MODULE = "bl_ext.user_default.primdiffusion"


def ours() -> list[str]:
    """Types that Blender knows."""
    return [name for name in dir(bpy.types) if "primdiffusion" in name.lower()]


report = Path(sys.argv[-1])
bpy.ops.preferences.addon_disable(module=MODULE)
for name in [name for name in sys.modules if name.startswith(MODULE)]:
    del sys.modules[name]  # as at the start of Blender
left, numpy = ours(), "numpy" in sys.modules
for _ in range(3):
    bpy.ops.preferences.addon_enable(module=MODULE)
    module = sys.modules[MODULE]
    for _ in range(2):
        module.unregister()
        left += ours()
        module.register()
    bpy.ops.preferences.addon_disable(module=MODULE)
    left += ours()
numpy = not numpy and "numpy" in sys.modules
report.write_text(json.dumps({"left": left, "numpy": numpy}))
