"""Where Cycles computes."""

from __future__ import annotations

import bpy

from .settings import Device

_KINDS = ("OPTIX", "CUDA", "HIP", "ONEAPI", "METAL")


def choose_device(scene: bpy.types.Scene, wanted: Device) -> str:
    """Set the scene's device and return what it is, in a sentence; the CPU where no GPU can be used.

    Of the preferences only the kind of device and which are used change, and only where none is chosen yet.
    """
    addon = bpy.context.preferences.addons.get("cycles")
    if wanted == "cpu" or addon is None:
        scene.cycles.device = "CPU"
        return "Cycles renders on the CPU."
    names = _gpus(addon.preferences)
    scene.cycles.device = "GPU" if names else "CPU"
    if names:
        return f"Cycles renders on {', '.join(names)}."
    return "No GPU can be used; Cycles renders on the CPU." if wanted == "gpu" else "Cycles renders on the CPU."


def _gpus(preferences: bpy.types.AddonPreferences) -> list[str]:
    chosen = preferences.compute_device_type
    kinds = (chosen,) if chosen != "NONE" else _KINDS
    for kind in kinds:
        try:
            preferences.compute_device_type = kind
        except TypeError:  # this Blender was built without it
            continue
        preferences.refresh_devices()
        devices = [device for device in preferences.devices if device.type == kind]
        if chosen == "NONE":
            for device in devices:
                device.use = True
        if names := [device.name for device in devices if device.use]:
            return names
    preferences.compute_device_type = chosen
    return []
