"""Scenes of the 3D view: shadings, the engine's own view, and how long the window is blocked (see `scenes.py`)."""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable
from importlib import import_module

import bpy
import gpu
from mathutils import Quaternion
from panels import show, view, wide_view
from press import Steps, press, wait
from stalls import Stalls, measure_extension
from start import FIRST_SEED, SECOND_SEED, armatures, begin, clear_of_the_sidebar, queue_of, select, with_people
from visible_scene import at_rest

REDRAW_ROUNDS, REDRAWS = 5, 6
"""Rounds of all states, and redraws in each."""
AFTERWARDS_S = 3.0
"""After a human's volumes are written: views refine their pictures."""


def shadings(module: str, python: str) -> Steps:
    """Two humans among solids in each shading, turned, clipped and from the camera."""
    yield from with_people(module, python, FIRST_SEED, SECOND_SEED)
    clear_of_the_sidebar()
    armatures()[1].location.y -= 1.0  # in front of the plane
    bpy.ops.mesh.primitive_cube_add(size=0.4, location=(0.1, -0.4, 0.9))
    bpy.ops.mesh.primitive_plane_add(size=6, location=(0, 0.15, 0), rotation=(1.4, 0, 0.3))
    wide_view()
    window, area = view()
    space = area.spaces.active
    space.overlay.show_bones = True
    for shading in ("SOLID", "MATERIAL", "WIREFRAME"):
        space.shading.type = shading
        yield 20.0
        yield f"shadings_{shading.lower()}"
    space.shading.type, space.shading.show_xray = "SOLID", True
    yield 5.0
    yield "shadings_xray"
    space.shading.show_xray = False
    for _ in range(8):
        space.region_3d.view_rotation = Quaternion((0, 0, 1), 0.1) @ space.region_3d.view_rotation
        yield 0.3
    yield "shadings_turning"
    region = next(region for region in area.regions if region.type == "WINDOW")
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.screen.region_quadview()
    yield 15.0
    yield "shadings_quad"
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.screen.region_quadview()


def rendered(module: str, python: str) -> Steps:
    """The engine's view: a human among solids, turned step by step, from the side in parallel, from the camera."""
    yield from with_people(module, python, FIRST_SEED)
    for location, size in (((0.5, -0.2, 0.4), 0.8), ((0.0, 0.0, 0.0), 0.1)):
        bpy.ops.mesh.primitive_cube_add(size=size, location=location)
    bpy.context.object.scale = (30.0, 30.0, 0.01)
    yield from rendered_view(module)
    yield "rendered_still"
    _, area = view()
    around = area.spaces.active.region_3d
    measured = Stalls()
    for step in range(12):
        around.view_rotation = Quaternion((0, 0, 1), 0.15) @ around.view_rotation
        yield 0.3
        if step in (0, 11):
            yield f"rendered_turning_{step}"
    yield 20.0
    print(f"turning and refining: {measured.end()}", flush=True)
    yield "rendered_turned"
    around.view_perspective = "ORTHO"
    yield 20.0
    yield "rendered_parallel"
    bpy.ops.object.camera_add(location=(0.4, -2.6, 1.3), rotation=(1.5, 0.0, 0.1))
    bpy.context.scene.camera = bpy.context.object
    around.view_perspective = "CAMERA"
    yield 20.0
    yield "rendered_from_the_camera"
    bpy.context.scene.primdiffusion_render.view = "ALPHA"
    yield 5.0
    yield "rendered_says_that_alpha_is_for_renders"


def stalls(module: str, python: str) -> Steps:
    """Measures how long the window is blocked by adding two people, varying one, and dragging a slider."""
    yield from begin(module, python)
    yield from show("PRIMDIFFUSION_PT_generate")
    queue = queue_of(module)
    measure_extension(module)
    yield {"figures": {"window_blender": bpy.app.version_string, "window_gpu": gpu.platform.renderer_get()}}
    yield from entering(module, FIRST_SEED, "")
    yield from entering(module, SECOND_SEED, "second_")
    yield "stalls_person"
    select(armatures()[0])
    measured = Stalls()
    press("primdiffusion.vary", seed=SECOND_SEED)
    yield from wait(lambda: not queue.busy, 240)
    yield 3.0
    print(f"varying a person: {measured.end()}", flush=True)
    settings = armatures()[0].primdiffusion_human
    yield 2.0
    measured = Stalls()
    for move in range(10):
        settings.betas[0] = 0.2 * move
        yield 0.01
    print(f"dragging a slider: {measured.end()}", flush=True)


def entering(module: str, seed: int, prefix: str) -> Steps:
    """Generate a person and measure from the child's answer until a view shows them."""
    queue, overlay = queue_of(module), import_module(f"{module}.engine.gpu.overlay").overlay
    humans = len(armatures()) + 1

    def shown() -> set[tuple]:
        pictures = [picture.shown for picture in overlay._regions.values() if picture.shown is not None]
        return {march.request.key[0] for march in pictures}  # a picture's key begins with its humans

    def in_view() -> bool:
        return any(len(key) == humans for key in shown() - before)

    before, load = shown(), os.getloadavg()[0]
    press("primdiffusion.generate", seed=seed)
    measured = Stalls({"answered": lambda: queue.ready, "standing": lambda: not queue.busy, "in view": in_view})
    yield from wait(lambda: "in view" in measured.met, 240)
    yield from wait(lambda: not queue.busy, 240)
    yield AFTERWARDS_S
    print(f"adding a person: {measured.end()}", flush=True)
    answered = measured.met["answered"]
    gaps = [gap for gap in measured.gaps if gap.end > answered]
    figures = {
        "stand_seconds_window": measured.met["standing"] - answered,
        "in_view_seconds_window": measured.met["in view"] - answered,
        "longest_stall_entering_s": max(gap.wall for gap in measured.between("answered", "in view")),
        "longest_stall_s": max(gap.wall for gap in gaps),
        "longest_stall_extension_s": max(gap.ours for gap in gaps),
        "window_load": load,
    }
    yield {"figures": {prefix + name: round(value, 3) for name, value in figures.items()}}


def redraw(module: str, python: str) -> Steps:
    """Measures a redraw of the 3D view in Solid: of an empty scene, with a person whose volumes are hidden, with that
    person's armature alone, and the extension's drawing alone."""
    yield from with_people(module, python, FIRST_SEED)
    wide_view()
    view()[1].spaces.active.shading.type = "SOLID"
    overlay = import_module(f"{module}.engine.gpu.overlay")
    (person,) = [layer for layer in bpy.context.view_layer.layer_collection.children if layer.name == "Human"]
    settings = bpy.context.scene.primdiffusion_render
    states = {"empty": (True, False), "armature": (False, False), "person": (False, True)}
    """Whether the person's collection is excluded, and whether humans are drawn."""
    measured = {name: [] for name in (*states, "drawing")}
    draw = overlay.Overlay.draw

    def timed(self, context) -> None:
        measured["drawing"].append(finished_ms(lambda: draw(self, context)))

    yield from wait(lambda: overlay.overlay.resting and bool(overlay.overlay._regions), 120)
    for _ in range(REDRAW_ROUNDS):
        for name, (person.exclude, settings.in_viewports) in states.items():
            yield 1.0
            yield from wait(lambda: overlay.overlay.resting, 60)
            measured[name] += [finished_ms(redraw_view) for _ in range(REDRAWS)]
        overlay.Overlay.draw = timed
        redraw_view()
        overlay.Overlay.draw = draw
    found = {f"redraw_{name}_ms": statistics.median(times) for name, times in measured.items()}
    found["redraw_ratio"] = found["redraw_person_ms"] / (found["redraw_empty_ms"] + found["redraw_drawing_ms"])
    yield {"figures": found}


def redraw_view() -> None:
    press("wm.redraw_timer", type="DRAW", iterations=1)


def finished_ms(draw: Callable[[], object]) -> float:
    """Milliseconds of drawing, with what the GPU has left to do after it."""
    finish()
    began = time.perf_counter()
    draw()
    finish()
    return 1000 * (time.perf_counter() - began)


def finish() -> None:
    """Return when the GPU has drawn what it was given."""
    gpu.state.active_framebuffer_get().read_color(0, 0, 1, 1, 4, 0, "UBYTE")


def rendered_view(module: str) -> Steps:
    """The engine in the viewport, with a large view of the person, at its finest."""
    scene = bpy.context.scene
    scene.render.engine = "PRIMDIFFUSION"
    scene.view_settings.view_transform = "Standard"
    wide_view()
    yield from at_rest(module)
