"""The scenes: generators of screenshot names, seconds to wait and clicks (see `drive.py`).

Every scene gets the name of the extension's module and the backend's Python, and prepares what it needs.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import bpy
from file_scenes import cancelled_captures, copies, five_humans, handles, other_files, read_back
from moving_scenes import opening, playing, turning
from panels import show, sidebar, view, wide_view
from picture_scene import from_picture
from press import Steps, invoke, pose, press, wait
from start import (
    FIRST_SEED,
    SECOND_SEED,
    armatures,
    begin,
    cancel_all,
    clear_of_the_sidebar,
    queue_of,
    select,
    with_people,
)
from view_scenes import redraw, rendered, rendered_view, shadings, stalls
from visible_scene import at_rest, visible_humans


def set_up(module: str, python: str) -> Steps:
    """Preferences and sidebar without a backend; with one."""
    preferences = bpy.context.preferences.addons[module].preferences
    yield from sidebar()
    yield "set_up_sidebar"
    bpy.ops.screen.userpref_show("INVOKE_DEFAULT")
    window = bpy.context.window_manager.windows[-1]
    with bpy.context.temp_override(window=window):
        bpy.ops.preferences.addon_show(module=module)
    yield 1.0
    yield "set_up_preferences"
    preferences.backend_python = python
    yield 0.5
    yield "set_up_named"
    with bpy.context.temp_override(window=window):
        bpy.ops.wm.window_close()
    yield 0.5


def newcomer(module: str, python: str) -> Steps:
    """Blender's own ways to a human: Shift-A, F3, File > Import; F12 without a backend."""
    yield from begin(module, "")
    yield {"point": [500, 700]}
    for name, keys in {"add": ("shift+a", *"hum"), "search": ("F3", *"generate")}.items():
        for key in keys:
            yield {"key": key}
            yield 0.5
        yield f"newcomer_{name}"
        for _ in range(2):
            yield {"key": "Escape"}
            yield 0.5
    sample = Path(import_module(module).__file__).parent / "gallery" / "Sample.human"
    press("primdiffusion.import_human", filepath=str(sample))
    yield from wait(lambda: not queue_of(module).busy, 60)
    yield from sidebar()
    yield from at_rest(module)
    yield "newcomer_sample"
    press("primdiffusion.set_up_engine")
    yield {"key": "F12"}
    yield 5.0
    yield "newcomer_f12"


def first_human(module: str, python: str) -> Steps:
    """The sidebar as it opens, a real click on Generate Human, denoising, the human."""
    yield from begin(module, python)
    yield from sidebar()
    yield "first_sidebar"
    yield from click_generate()
    queue = queue_of(module)
    yield from wait(lambda: queue.busy, 5)
    if not queue.busy:
        raise RuntimeError("the click did not hit Generate Human")
    yield 1.0
    yield "first_starting"
    yield from wait(lambda: not queue.busy or has_picture(queue), 120)
    yield "first_denoising"
    window, _ = view()
    status_bar = [0, window.height - STATUS_BAR_PX, window.width, window.height]
    if not (yield {"pixels that differ": ["first_starting", "first_denoising"], "boxes": [status_bar]})[0]:
        raise RuntimeError("the status bar does not show the job's progress")
    yield from wait(lambda: not queue.busy, 240)
    yield from at_rest(module)
    yield "first_solid"
    yield from rendered_view(module)
    yield "first_person"


def generate(module: str, python: str) -> Steps:
    """A queue of three, an error with its remedy, a notice, attributes."""
    yield from with_people(module, python, FIRST_SEED)
    yield from show("PRIMDIFFUSION_PT_generate", "PRIMDIFFUSION_PT_jobs")
    yield "generate_notice"
    settings = bpy.context.scene.primdiffusion
    settings.count = 3
    press("primdiffusion.generate")
    queue = queue_of(module)
    yield from wait(lambda: has_picture(queue), 120)
    yield "generate_in_line"
    yield from cancel_all(module)
    settings.count = 1
    yield "generate_cancelled"
    preferences = bpy.context.preferences.addons[module].preferences
    preferences.checkpoint = "/nowhere/model.safetensors"
    press("primdiffusion.generate")
    yield from wait(lambda: not queue_of(module).busy, 60)
    yield "generate_error"
    preferences.checkpoint = ""
    queue_of(module).outcomes.clear()
    attributes = settings.attributes
    attributes.sex, attributes.outfit, attributes.hair = "female", "blouse and skirt", "braid"
    attributes.use_height = True
    yield from show("PRIMDIFFUSION_PT_generate/attributes")
    yield "generate_attributes"
    for name in ("sex", "outfit", "hair"):
        setattr(attributes, name, "ANY")
    attributes.use_height = False


def variations(module: str, python: str) -> Steps:
    """Eight in progress, the sheet, two selected."""
    yield from begin(module, python)
    yield from show("PRIMDIFFUSION_PT_generate/variations")
    yield "variations_empty"
    press("primdiffusion.variations", seed=40)
    queue = queue_of(module)
    yield from wait(lambda: queue.request is not None and bool(queue.request.pictures), 120)
    yield 0.5
    yield "variations_denoising"
    yield from wait(lambda: not queue.busy, 120)
    yield "variations_sheet"
    for index in (1, 5):
        bpy.context.window_manager.primdiffusion_selected[index] = True
    yield "variations_selected"


def human(module: str, python: str) -> Steps:
    """Shape before and after, facts, poses."""
    yield from with_people(module, python, FIRST_SEED)
    armature = armatures()[0]
    yield from show("PRIMDIFFUSION_PT_human/shape")
    yield from rendered_view(module)
    yield "human_shape_before"
    settings = armature.primdiffusion_human
    settings.betas[0], settings.betas[1] = 1.5, -2.0
    yield from at_rest(module)
    yield "human_shape_after"
    press("primdiffusion.reshape", to="GENERATED")
    yield 4.0
    yield from show("PRIMDIFFUSION_PT_advanced/facts")
    yield "human_details"
    yield from show("PRIMDIFFUSION_PT_human/pose")
    space = view()[1].spaces.active
    space.shading.type, space.overlay.show_bones = "SOLID", True
    press("view3d.view_selected", "EXEC_DEFAULT")
    press("object.posemode_toggle")
    yield 1.0  # until it is drawn in Pose Mode, the view has no asset shelf
    space.show_region_asset_shelf = True
    pose(bpy.context.active_object, "Waving")
    yield from at_rest(module)
    yield "human_poses"
    press("object.posemode_toggle")


def edits(module: str, python: str) -> Steps:
    """Vary, re-dress with parts and painted, transfer, blend."""
    yield from with_people(module, python, FIRST_SEED, SECOND_SEED)
    first, second = armatures()
    select(first)
    clear_of_the_sidebar()
    settings = bpy.context.scene.primdiffusion_edit
    settings.other = second
    yield from show("PRIMDIFFUSION_PT_human/edit")
    settings.kind = "TRANSFER"
    yield 0.5
    yield "edit_two_people"
    settings.kind, settings.parts = "REDRESS", {"clothes"}
    settings.attributes.outfit = "suit"
    yield "edit_parts"
    press("primdiffusion.redress")
    queue = queue_of(module)
    yield from wait(lambda: not queue.busy or has_picture(queue), 120)
    yield "edit_working"
    yield from wait(lambda: not queue.busy, 180)
    yield from rendered_view(module)
    yield "edit_redressed"
    settings.region = "PAINTED"
    press("primdiffusion.paint_region")
    yield 1.0
    paint(first)
    _, area = view()
    area.spaces.active.shading.type = "SOLID"
    yield from at_rest(module)
    yield "edit_painting"
    press("primdiffusion.paint_region", finish=True)
    settings.region = "PARTS"


def motion(module: str, python: str) -> Steps:
    """The empty panel, the dialog with what was detected in a file, after the import."""
    yield from with_people(module, python, FIRST_SEED)
    yield from show("PRIMDIFFUSION_PT_human/motion")
    yield from at_rest(module)
    yield "motion_empty"
    path = Path(bpy.app.tempdir) / "walk_01.npz"
    press("primdiffusion.add_motion", motion="WALK", rounds=3)
    press("primdiffusion.export_motion", "EXEC_DEFAULT", filepath=str(path))
    armature = armatures()[0]
    armature.animation_data_clear()
    for bone in armature.pose.bones:
        bone.matrix_basis.identity()  # the view is as in motion_empty, but for the dialog
    yield from at_rest(module)
    yield {"point": [500, 500]}
    invoke("primdiffusion.import_motion", filepath=str(path))
    yield 1.0
    yield "motion_dialog"
    yield {"key": "Escape"}
    yield 0.5
    press("primdiffusion.import_motion", "EXEC_DEFAULT", filepath=str(path))
    yield from rendered_view(module)
    bpy.context.scene.frame_set(14)
    yield from at_rest(module)
    yield "motion_imported"


def render(module: str, python: str) -> Steps:
    """Engine and Cycles, what shows the human, merging, gain."""
    yield from with_people(module, python, FIRST_SEED)
    names = ("render", *(f"advanced/{section}" for section in ("show_as", "merge", "facts")))
    yield from show(*(f"PRIMDIFFUSION_PT_{name}" for name in names))
    press("primdiffusion.set_up_engine", engine="CYCLES")
    yield "render_cycles"
    queue = queue_of(module)
    yield 3.0
    yield "render_merging"
    yield from wait(lambda: not queue.busy, 240)
    yield "render_merged"
    pose(bpy.context.active_object, "Waving")
    press("primdiffusion.set_up_engine")
    yield "render_outdated"


def captures(module: str, python: str) -> Steps:
    """Render Captures with its settings."""
    yield from begin(module, python)
    bpy.context.preferences.addons[module].preferences.captures = True
    yield from show("PRIMDIFFUSION_PT_captures")
    for name in ("people", "out"):
        folder = Path(tempfile.gettempdir()) / "shots" / {"people": "scans", "out": "captures"}[name]
        folder.mkdir(exist_ok=True, parents=True)
        setattr(bpy.context.scene.primdiffusion_captures, name, str(folder))
    yield 1.0
    yield "captures_settings"


def export(module: str, python: str) -> Steps:
    """A mesh, and the mesh proxy in the scene."""
    yield from with_people(module, python, FIRST_SEED)
    wide_view()
    view()[1].spaces.active.shading.type = "SOLID"  # which shows the mesh's texture as soon as it is there
    bpy.context.scene.primdiffusion_export.format = "GLB"
    yield from show("PRIMDIFFUSION_PT_export/proxy")
    yield "export_before"
    press("primdiffusion.add_proxy")
    queue = queue_of(module)
    yield 3.0
    yield "export_working"
    yield from wait(lambda: not queue.busy, 300)
    yield 2.0
    yield "export_proxy"


def cancelled(module: str, python: str) -> Steps:
    """Measures how long cancelling a job in the middle of its steps takes."""
    yield from begin(module, python)
    yield from show("PRIMDIFFUSION_PT_generate", "PRIMDIFFUSION_PT_jobs")
    queue = queue_of(module)
    for seed in (FIRST_SEED, SECOND_SEED, FIRST_SEED):
        press("primdiffusion.generate", seed=seed)
        yield from wait(lambda: queue.request is not None and queue.request.step > 1, 120)
        start = time.monotonic()
        press("primdiffusion.cancel")
        yield from wait(lambda: not queue.busy, 10)
        print(f"cancelling a job: {time.monotonic() - start:.2f} s", flush=True)
    yield "cancelled"


def paint(armature: bpy.types.Object) -> None:
    """Set the weights of the chest, because brush strokes need a mouse."""
    body = bpy.context.view_layer.objects.active
    group = body.vertex_groups.active
    mode = body.mode
    bpy.ops.object.mode_set(mode="OBJECT")
    rest = armature.data.bones
    low, high = rest["spine1"].head_local.z, rest["neck"].head_local.z
    wanted = [v.index for v in body.data.vertices if low < (body.matrix_local @ v.co).z < high and abs(v.co.x) < 0.17]
    group.add(wanted, 1.0, "REPLACE")
    bpy.ops.object.mode_set(mode=mode)


def click_generate() -> Steps:
    """Click Generate Human with the mouse."""
    window, area = view()
    region = next(region for region in area.regions if region.type == "UI")
    x = region.x + region.width // 2 - 20
    top = window.height - region.y - region.height
    yield {"point": [x, top + GENERATE_BUTTON_PX], "click": True}
    yield 0.5
    yield {"point": [x - 400, top + 300]}


GENERATE_BUTTON_PX = 118
"""Distance from the top of the sidebar, with the panel as it opens."""

STATUS_BAR_PX = 20
"""Height of the status bar, less its border."""

SCENES: dict[str, Callable[[str, str], Steps]] = {
    "set_up": set_up,
    "newcomer": newcomer,
    "first_human": first_human,
    "visible_humans": visible_humans,
    "generate": generate,
    "variations": variations,
    "human": human,
    "edits": edits,
    "motion": motion,
    "render": render,
    "shadings": shadings,
    "rendered": rendered,
    "captures": captures,
    "from_picture": from_picture,
    "export": export,
    "cancelled": cancelled,
    "five_humans": five_humans,
    "other_files": other_files,
    "copies": copies,
    "read_back": read_back,
    "handles": handles,
    "cancelled_captures": cancelled_captures,
    "stalls": stalls,
    "redraw": redraw,
    "opening": opening,
    "turning": turning,
    "playing": playing,
}


def has_picture(queue) -> bool:
    """Whether the running job shows a picture of its human so far."""
    return queue.request is not None and queue.request.picture is not None
