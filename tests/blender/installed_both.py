"""Run by test_registration in a Blender of its own: install two zips, enable one beside and after the other.

python installed_both.py ZIP ZIP
"""

import json
import sys

import bpy


def ours() -> set[str]:
    """The modules whose classes are registered."""
    names = [name for name in dir(bpy.types) if name.startswith("PRIMDIFFUSION_")]
    return {".".join(getattr(bpy.types, name).__module__.split(".")[:3]) for name in names}


def enabled() -> list[str]:
    return [addon.module for addon in bpy.context.preferences.addons if "primdiffusion" in addon.module]


report: dict = {"message": ""}
bpy.ops.extensions.package_install_files(filepath=sys.argv[1], repo="user_default", enable_on_install=True)
bpy.ops.extensions.package_install_files(filepath=sys.argv[2], repo="user_default", enable_on_install=False)
(first,) = enabled()
(second,) = {"bl_ext.user_default.primdiffusion", "bl_ext.user_default.primdiffusion_viewer"} - {first}
try:
    bpy.ops.preferences.addon_enable(module=second)
except RuntimeError as error:
    report["message"] = str(error)
report["beside"] = (enabled(), sorted(ours()), second in sys.modules)
bpy.ops.preferences.addon_disable(module=first)
report["after"] = (bpy.ops.preferences.addon_enable(module=second) == {"FINISHED"}, enabled(), sorted(ours()))
report["first"], report["second"] = first, second
print("REPORT " + json.dumps(report), flush=True)
