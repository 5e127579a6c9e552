"""The sidebar panel Advanced: how volumes follow the body, merging, the look in Cycles, memory, files, the backend."""

from __future__ import annotations

import bpy

from ..backend.requests import sentence
from ..formats.regular_files import printable
from ..formats.requests import DENSITY_GAIN, VOXEL
from ..jobs.deferred_volumes import deferred_volumes, keep_writing
from ..jobs.export import show, shown
from ..jobs.follow import submit
from ..jobs.merge import MergeFramesJob, MergeJob, Moment
from ..jobs.target import HumanTarget, selected_person
from ..places import backend_is_named
from ..scene.attachment import (
    attachment_before_merge,
    attachment_of,
    in_viewport,
    set_attachment,
    show_in_viewport,
)
from ..scene.blend_values import as_shown
from ..scene.cycles import current_overlap, overlap_warning_in
from ..scene.human import humans, parts_of, provenance_of
from ..scene.material import density_gain, set_density_gain
from ..scene.merged import merged_of, merged_state, remove_merged
from ..scene.proxy import proxy_of
from ..scene.splats import SPLATS_AVAILABLE, cloud_of
from ..scene.volumes import Memory, person_memory
from .declared import SKIP
from .drawing import SidebarPanel, draw_job, draw_lines, draw_section, property_columns
from .jobs_panel import draw_backend
from .on_person import OnPerson

ATTACHMENT_ITEMS = (
    ("ARMATURE", "Armature", "Each volume is an object that follows the bones; fast, and the default"),
    ("SURFACE", "Surface", "Volumes are placed on the posed skin in each pose, as in the PrimDiffusion engine"),
    ("MERGED", "Merged", "The merged volume, in the pose it was merged in; far faster in Cycles"),
    (
        "SPLATS",
        "Splats",
        "Gaussian splats, which every view and engine draws: they cast shadows, but keep the light of their colors "
        "(Blender 5.3)",
    ),
)
_MOST_FRAMES = 3_000


class PRIMDIFFUSION_OT_set_attachment(OnPerson, bpy.types.Operator):
    """Choose how the selected human's volumes follow the body"""

    bl_idname = "primdiffusion.set_attachment"
    bl_label = "Set Attachment"
    bl_options = {"UNDO"}
    described_by = ("mode",)

    mode: bpy.props.EnumProperty(
        name="Attachment", description="How volumes follow the body", items=ATTACHMENT_ITEMS, default="ARMATURE"
    )

    def run(self, context: bpy.types.Context, person: bpy.types.Object) -> set[str]:
        set_attachment(person, self.mode)
        keep_writing()  # volumes that splats had made unnecessary
        return {"FINISHED"}


class PRIMDIFFUSION_OT_volumes_in_viewport(OnPerson, bpy.types.Operator):
    """Show or hide the selected human's volumes in viewports; drawn, they take a gigabyte. Renders always have them"""

    bl_idname = "primdiffusion.volumes_in_viewport"
    bl_label = "Volumes in Viewport"
    bl_options = {"UNDO"}

    everyone: bpy.props.BoolProperty(name="All Humans", description="Do it for all humans of the scene", options=SKIP)

    def run(self, context: bpy.types.Context, person: bpy.types.Object) -> set[str]:
        visible = not in_viewport(person)
        if visible:
            deferred_volumes.finish()
        for each in humans(context.scene) if self.everyone else [person]:
            what = shown(each)
            show_in_viewport(each, visible)
            if proxy_of(each) is not None:
                show(each, what)
        return {"FINISHED"}


_MERGES = (
    (
        "POSE",
        "Current Pose",
        "Merge the selected human's volumes, in the current pose, into one that Cycles renders much faster",
    ),
    (
        "FRAMES",
        "Frame Range",
        "Merge the human's volumes into one volume for each frame of the scene's range, in the background",
    ),
    ("NOTHING", "Nothing", "Show the human's own volumes again and remove the merged one"),
)


class PRIMDIFFUSION_OT_merge(OnPerson, bpy.types.Operator):
    """Merge the selected human's volumes into one that Cycles renders much faster, or show its own volumes again"""

    bl_idname = "primdiffusion.merge"
    bl_label = "Merge Volumes"
    described_by = ("what",)

    what: bpy.props.EnumProperty(name="Merge", description="What is merged", items=_MERGES, options=SKIP)
    voxel: bpy.props.FloatProperty(
        name="Voxel Size",
        description="Metres. Not given: the panel's",
        min=0.0005,
        default=VOXEL,
        options=SKIP,
    )
    frame_start: bpy.props.IntProperty(name="Start", description="Not given: the scene's", options=SKIP)
    frame_end: bpy.props.IntProperty(name="End", description="Not given: the scene's", options=SKIP)

    def run(self, context: bpy.types.Context, person: bpy.types.Object) -> set[str]:
        if self.what == "NOTHING":
            _unmerge(person)
            bpy.ops.ed.undo_push(message="Unmerge")
            return {"FINISHED"}
        target, voxel = HumanTarget.of(person), self.chosen("voxel", context.scene.primdiffusion_merging)
        if self.what == "POSE":
            moment = _moment(person, context.evaluated_depsgraph_get())
            return submit(self, context, MergeJob(target, moment, voxel))
        start, end = (self.chosen(name, context.scene) for name in ("frame_start", "frame_end"))
        if not 1 < end - start + 1 <= _MOST_FRAMES:
            raise ValueError(
                f"frames {start} to {end} are no sequence: give a start and a later end, of at most {_MOST_FRAMES}"
            )
        moments = _moments(context, person, range(start, end + 1))
        return submit(self, context, MergeFramesJob(target, moments, start, voxel))


def _unmerge(person: bpy.types.Object) -> None:
    """Raises ValueError where there is no merged volume."""
    if merged_of(person) is None:
        raise ValueError(f"{person.name!r} has no merged volume")
    if attachment_of(person) == "MERGED":
        set_attachment(person, attachment_before_merge(person))
    remove_merged(person)


def _moment(person: bpy.types.Object, graph: bpy.types.Depsgraph) -> Moment:
    return Moment.now(person, person.evaluated_get(graph))


def _moments(context: bpy.types.Context, person: bpy.types.Object, frames: range) -> list[Moment]:
    """The human in each frame; the scene is at its own frame again afterwards."""
    scene, now = context.scene, context.scene.frame_current
    moments = []
    try:
        for frame in frames:
            scene.frame_set(frame)
            moments.append(_moment(person, context.evaluated_depsgraph_get()))
    finally:
        scene.frame_set(now)
    return moments


class PRIMDIFFUSION_PG_merging(bpy.types.PropertyGroup):
    """`scene.primdiffusion_merging`."""

    voxel: bpy.props.FloatProperty(
        name="Voxel Size",
        description="Voxel size of the merged volume: half the size shows more detail and takes eight times the memory",
        subtype="DISTANCE",
        unit="LENGTH",
        default=VOXEL,
        min=0.001,
        max=0.1,
        soft_min=0.003,
        soft_max=0.02,
        step=0.1,
        precision=4,
    )


def _gain(person: bpy.types.Object) -> float:
    gain = density_gain(person)
    return DENSITY_GAIN if gain is None else gain


def _set_gain(person: bpy.types.Object, gain: float) -> None:
    try:
        set_density_gain(person, gain)
    except ValueError as error:  # a property has no report
        print(printable(f"PrimDiffusion: {error}"))


def gain_property() -> bpy.props.FloatProperty:
    """`armature.primdiffusion_density_gain` of a human."""
    return bpy.props.FloatProperty(
        name="Density Gain",
        description="Factor on the density in Cycles, which absorbs exponentially while the PrimDiffusion "
        "engine adds opacity up",
        min=0.01,
        max=100.0,
        soft_min=0.5,
        soft_max=5.0,
        step=10,
        get=_gain,
        set=_set_gain,
    )


class PRIMDIFFUSION_PT_advanced(SidebarPanel, bpy.types.Panel):
    """What a first picture does not need, in closed sections."""

    bl_label = "Advanced"
    bl_order = 4
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        layout = property_columns(self.layout)
        if humans(context.scene):
            _draw_person(layout, context)
        if not backend_is_named():
            return
        backend = draw_section(layout, "backend", text="Backend", page="troubleshooting")
        if backend is not None:
            draw_backend(backend)


def _draw_person(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Sections of the selected human."""
    try:
        person = selected_person(context)
    except ValueError as error:
        draw_lines(layout, sentence(error), "INFO")
        return
    page = "rendering"
    sections = [
        (draw_section(layout, "attachment", text="Attachment", page=page, section="attachment"), _draw_attachment),
        (draw_section(layout, "look", text="Look in Cycles", page=page, section="look-in-cycles"), _draw_cycles_look),
        (draw_section(layout, "memory", text="Memory", page=page, section="memory"), _draw_memory),
    ]
    if backend_is_named():
        merge = draw_section(layout, "merge", text="Merge for Cycles", page=page, section="merge-for-cycles")
        sections.append((merge, _draw_merge))
    for body, content in sections:
        if body is not None:
            content(body, context, person)


def _draw_attachment(layout: bpy.types.UILayout, _context: bpy.types.Context, person: bpy.types.Object) -> None:
    """How volumes follow the body."""
    now = attachment_of(person)
    absent = {"MERGED": merged_of(person) is None, "SPLATS": not SPLATS_AVAILABLE}
    row = layout.row(align=True)
    for mode, label, _ in ATTACHMENT_ITEMS:
        if not absent.get(mode):
            row.operator("primdiffusion.set_attachment", text=label, depress=mode == now).mode = mode
    if now != "SPLATS":
        icon = "RESTRICT_VIEW_OFF" if in_viewport(person) else "RESTRICT_VIEW_ON"
        layout.operator("primdiffusion.volumes_in_viewport", depress=in_viewport(person), icon=icon)


def _draw_merge(layout: bpy.types.UILayout, context: bpy.types.Context, person: bpy.types.Object) -> None:
    """One volume for Cycles."""
    layout.prop(context.scene.primdiffusion_merging, "voxel")
    draw_job(layout, "merge", "primdiffusion.merge", "VOLUME_DATA", text="Merge Pose")
    frames = draw_job(layout, "merge_frames", "primdiffusion.merge", "RENDER_ANIMATION", text="Merge Frame Range")
    frames.what = "FRAMES"
    if merged_of(person) is not None:
        if outdated(person, context.scene):
            draw_lines(layout, "The merged volume is of another pose: merge again to update it", "ERROR")
        layout.operator("primdiffusion.merge", text="Unmerge", icon="X").what = "NOTHING"


def _draw_cycles_look(layout: bpy.types.UILayout, context: bpy.types.Context, person: bpy.types.Object) -> None:
    """What brings Cycles near the exact picture."""
    if attachment_of(person) == "SPLATS":
        draw_lines(layout, "Splats look the same in every engine", "INFO")
        return
    if density_gain(person) is None:
        draw_lines(layout, "The human's material has no node Density Gain", "INFO")
    else:
        layout.prop(person, "primdiffusion_density_gain")
    warning = overlap_warning_in(context.scene, person)
    if warning is not None and attachment_of(person) != "MERGED":
        draw_lines(layout, sentence(f"{warning}, or merge the human"), "ERROR")


def _draw_memory(layout: bpy.types.UILayout, _context: bpy.types.Context, person: bpy.types.Object) -> None:
    """How the human was made, and what it takes."""
    column = layout.column(align=True)
    for name, value in details(person):
        column.label(text=f"{name}: {value}", translate=False)


def outdated(person: bpy.types.Object, scene: bpy.types.Scene) -> bool:
    """Whether the merged volume shows another pose, shape or human than the armature as it is now."""
    try:
        return not merged_state(merged_of(person)).shows(Moment.now(person).digest, scene.frame_current)
    except (ValueError, OSError):  # other panels report broken bones and files
        return True


_SHOWN = ("seed", "steps", "sampler", "guidance", "checkpoint", "version")
"""Fields of the provenance, in this order."""
_MOST_LINES = 60
"""Lines about the provenance."""


def details(person: bpy.types.Object) -> list[tuple[str, str]]:
    """Names and values: how the human was made, what its files and volumes take."""
    provenance = provenance_of(person)
    attributes, edits = provenance.get("attributes"), provenance.get("edits")
    shown = {name: provenance[name] for name in _SHOWN if provenance.get(name) not in (None, "")}
    lines = [(name.capitalize(), as_shown(value)) for name, value in shown.items()]
    if isinstance(attributes, dict):
        lines += [(as_shown(name.capitalize()), as_shown(value)) for name, value in attributes.items()]
    if isinstance(missed := provenance.get("unfollowed"), dict):
        shows = [f"{name} (shows {value})" for name, value in missed.items()]
        lines.append(("Not followed", as_shown(", ".join(shows))))
    for edit in edits if isinstance(edits, list) else ():
        if isinstance(edit, dict):
            rest = [f"{key} {value}" for key, value in edit.items() if key != "edit" and not isinstance(value, dict)]
            lines.append((f"Edit: {as_shown(edit.get('edit', '?'))}", as_shown(", ".join(rest))))
    del lines[_MOST_LINES:]
    cloud = cloud_of(person)
    if cloud is not None:
        lines.append(("Splats", f"{len(cloud.data.points):,}"))
    volumes = [obj for obj in parts_of(person) if obj.type == "VOLUME"]
    if not volumes:
        return lines
    try:
        memory = person_memory(person)
    except (ValueError, OSError):  # the panel Human says why
        memory = Memory(0, 0)
    try:
        most = str(current_overlap(person))
    except ValueError:  # changed by hand
        most = "?"
    lines.append(("Volumes", f"{len(volumes)}, up to {most} overlap"))
    lines.append(("Memory once drawn", f"{memory.grids / 1e6:.0f} MB"))
    lines.append(("Files", f"{memory.files / 1e6:.0f} MB"))
    return lines


PROPERTIES = (
    (bpy.types.Scene, "primdiffusion_merging", bpy.props.PointerProperty(type=PRIMDIFFUSION_PG_merging)),
    (bpy.types.Object, "primdiffusion_density_gain", gain_property()),
)
