"""What a newcomer sees of the first two humans, from Blender's factory scene: pictures, and the share of each human's
pixels that neither other objects nor panels hide."""

from __future__ import annotations

import gc
from importlib import import_module

import bpy
import numpy as np
from panels import sidebar, view
from press import Steps, press, wait
from start import FIRST_SEED, SECOND_SEED, armatures, begin, queue_of

_WIDER = 3
"""Times as wide: a view in which the parts of a human outside of the region are seen as well."""
_BACKGROUND = {"background_type": "VIEWPORT", "background_color": (1.0, 0.0, 1.0)}
"""Unlike any human."""
_MOST_S = 240.0


def visible_humans(module: str, python: str) -> Steps:
    """Two humans, one after the other, each as it first appears."""
    yield from begin(module, python)
    yield from sidebar()
    for name, seed in (("first", FIRST_SEED), ("second", SECOND_SEED)):
        press("primdiffusion.generate", seed=seed)
        yield from wait(lambda: not queue_of(module).busy, 600)
        yield from at_rest(module)
        yield f"visible_{name}"
        check_drawn(module)
        share = yield from visible_share(module, name, armatures()[-1])
        yield {"figures": {f"{name}_human_visible_share": round(share, 3)}}
        yield from at_rest(module)
    press("object.mode_set", "EXEC_DEFAULT", mode="POSE")
    yield from at_rest(module)
    yield "visible_posing"
    press("object.mode_set", "EXEC_DEFAULT", mode="OBJECT")
    yield from at_rest(module)
    yield "visible_again"


def visible_share(module: str, name: str, armature: bpy.types.Object) -> Steps:
    """Returns the share of the human's pixels that the window shows: those that change when the human is hidden, by
    those that would without panels and other objects. The view is afterwards as before."""
    _, area = view()
    space, region = area.spaces.active, next(region for region in area.regions if region.type == "WINDOW")
    shown = {"show_text": False, "show_bones": False, "show_object_origins": False, "show_outline_selected": False}
    before = {overlay: getattr(space.overlay, overlay) for overlay in shown}
    set_all(space.overlay, shown)
    shading = {name: getattr(space.shading, name) for name in ("background_type", "background_color")}
    shading["background_color"] = tuple(shading["background_color"])
    set_all(space.shading, _BACKGROUND)
    box = on_screen(region)
    (visible,) = yield from changed_pixels(module, name, armature, [box])
    size, lens = (region.width, region.height), space.lens
    others = [obj for obj in bpy.context.view_layer.objects if obj.visible_get() and obj != armature]
    for obj in others:
        obj.hide_set(True)
    alone = {"show_gizmo": False, "show_region_ui": False, "show_region_toolbar": False}
    were = {setting: getattr(space, setting) for setting in alone}
    set_all(space, alone)
    space.overlay.show_overlays = False
    humans = [layer for layer in layers() if any("primdiffusion_human" in obj for obj in layer.collection.objects)]
    without = [layer for layer in humans if armature.name not in layer.collection.objects]
    for layer in without:
        layer.exclude = True
    (whole,) = yield from changed_pixels(module, f"{name}_alone", armature, [box])
    space.lens = lens / _WIDER
    inside, all_of_it = yield from changed_pixels(module, f"{name}_wider", armature, [middle_of(box), box])
    if (region.width, region.height) != size:
        raise RuntimeError(f"the view's size changed with its panels, from {size}")
    space.lens, space.overlay.show_overlays = lens, True
    for layer in without:
        layer.exclude = False
    for obj in others:
        obj.hide_set(False)
    set_all(space, were)
    set_all(space.overlay, before)
    set_all(space.shading, dict(reversed(shading.items())))
    print(f"{name}: {visible=} {whole=} {inside=} {all_of_it=}", flush=True)
    return min(visible / whole, 1.0) * inside / all_of_it


def changed_pixels(module: str, name: str, armature: bpy.types.Object, boxes: list[list[int]]) -> Steps:
    """Returns how many pixels within each of these boxes change when the human is hidden."""
    (layer,) = [layer for layer in layers() if armature.name in layer.collection.objects]
    yield from at_rest(module)
    yield f"visible_{name}_with"
    layer.exclude = True
    yield from at_rest(module)
    yield f"visible_{name}_without"
    layer.exclude = False
    bpy.context.view_layer.objects.active = armature
    armature.select_set(True)
    pictures = [f"visible_{name}_with", f"visible_{name}_without"]
    return (yield {"pixels that differ": pictures, "boxes": boxes})


def layers() -> list[bpy.types.LayerCollection]:
    return list(bpy.context.view_layer.layer_collection.children)


def at_rest(module: str) -> Steps:
    """Until the views show their finest pictures, those that the engine draws too."""
    overlay = import_module(f"{module}.engine.gpu.overlay").overlay
    kind = import_module(f"{module}.engine.viewport").Viewport
    yield 1.0
    rendered = [each for each in gc.get_objects() if isinstance(each, kind)]  # Blender alone holds the engines
    yield from wait(lambda: overlay.resting and all(view.resting for view in rendered), _MOST_S)
    yield 1.0


def check_drawn(module: str) -> None:
    """Raise RuntimeError where the finest picture of a view has no pixel of a human."""
    overlay = import_module(f"{module}.engine.gpu.overlay").overlay
    far = import_module(f"{module}.engine.view").NO_SURFACE_M
    for picture in overlay._regions.values():
        if not (np.array(picture.shown.picture.depth.read(), np.float32) < far).any():
            raise RuntimeError("a view at rest shows no human")


def set_all(holder: object, settings: dict[str, object]) -> None:
    for name, value in settings.items():
        setattr(holder, name, value)


def on_screen(region: bpy.types.Region) -> list[int]:
    """Left, top, right, bottom in pixels of the screen."""
    window, _ = view()
    top = window.height - region.y - region.height
    return [region.x, top, region.x + region.width, top + region.height]


def middle_of(box: list[int]) -> list[int]:
    """What of a box a view without `_WIDER` shows."""
    left, top, right, bottom = box
    x, y = (right - left) * (1 - 1 / _WIDER) / 2, (bottom - top) * (1 - 1 / _WIDER) / 2
    return [round(left + x), round(top + y), round(right - x), round(bottom - y)]
