"""The sidebar panel Advanced: splats, volumes or a merged volume, facts."""

from __future__ import annotations

import bpy

from ..backend.requests import sentence
from ..formats.requests import VOXEL
from ..jobs.follow import submit
from ..jobs.volumes import MergeJob, PoseSnapshot, VolumesJob
from ..places import backend_is_named
from ..scene.actions import posed_on
from ..scene.blend_values import as_shown
from ..scene.human import HumanTarget, humans, provenance_of, proxy_of, selected_person
from ..scene.merged import merged_of, merged_state, remove_merged
from ..scene.proxy import remove_proxy
from ..scene.representation import (
    MESH_IN_VIEWPORT,
    in_viewport,
    mesh_in_viewport,
    representation_of,
    set_representation,
    show_in_viewport,
    stop_showing,
)
from ..scene.splats import SPLATS_AVAILABLE, cloud_of
from .declared import SKIP
from .drawing import SidebarPanel, draw_job, draw_lines, draw_section, property_columns
from .generate_settings import SAMPLER_NAMES
from .on_person import HumanOperator

REPRESENTATIONS = (
    (
        "SPLATS",
        "Splats",
        "Gaussian splats, which every view and engine draws: they cast shadows, but keep the light of their colors "
        "(Blender 5.3)",
    ),
    ("VOLUMES", "Volumes", "A volume for each box, which follow every pose; Cycles needs minutes"),
    ("MERGED", "Merged", "The merged volume, in the pose it was merged in; far faster in Cycles"),
    ("MESH", "Mesh", "The mesh proxy, in renders and viewports"),
    (MESH_IN_VIEWPORT, "Mesh in Viewport", "The mesh proxy while working; renders show what they showed before"),
)
_NO_MESH = ("NO_MESH", "Remove Mesh Proxy", "Delete the mesh proxy, and show what there was before")
_MOST_FRAMES = 3_000


class PRIMDIFFUSION_OT_set_representation(HumanOperator, bpy.types.Operator):
    """Choose what renders and viewports show of the selected human"""

    bl_idname = "primdiffusion.set_representation"
    bl_label = "Show As"
    bl_options = {"UNDO"}
    described_by = ("representation",)

    representation: bpy.props.EnumProperty(
        name="Show As", description="What shows the human", items=(*REPRESENTATIONS, _NO_MESH), default="VOLUMES"
    )

    def run(self, context: bpy.types.Context, person: bpy.types.Object) -> set[str]:
        if self.representation != "NO_MESH":
            set_representation(person, self.representation)
        elif (proxy := proxy_of(person)) is None:
            raise ValueError(f"{person.name!r} has no mesh proxy")
        else:
            stop_showing(person, "MESH")
            remove_proxy(proxy)
        return {"FINISHED"}


class PRIMDIFFUSION_OT_volumes_in_viewport(HumanOperator, bpy.types.Operator):
    """Show or hide the selected human's volumes in viewports; drawn, they take a gigabyte. Renders always have them"""

    bl_idname = "primdiffusion.volumes_in_viewport"
    bl_label = "Volumes in Viewport"

    def run(self, context: bpy.types.Context, person: bpy.types.Object) -> set[str]:
        if not in_viewport(person) and representation_of(person) == "VOLUMES":
            return submit(self, context, VolumesJob(HumanTarget.of(person)))
        show_in_viewport(person, not in_viewport(person))
        bpy.ops.ed.undo_push(message=self.bl_label)
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


class PRIMDIFFUSION_OT_merge(HumanOperator, bpy.types.Operator):
    """Merge the selected human's volumes into one that Cycles renders much faster, or show its own volumes again"""

    bl_idname = "primdiffusion.merge"
    bl_label = "Merge Volumes"
    described_by = ("what",)

    what: bpy.props.EnumProperty(name="Merge", description="What is merged", items=_MERGES, options=SKIP)

    def run(self, context: bpy.types.Context, person: bpy.types.Object) -> set[str]:
        if self.what == "NOTHING":
            _unmerge(person)
            bpy.ops.ed.undo_push(message="Unmerge")
            return {"FINISHED"}
        target, voxel = HumanTarget.of(person), context.scene.primdiffusion_merging.voxel
        if self.what == "POSE":
            moment = PoseSnapshot.capture(person, person.evaluated_get(context.evaluated_depsgraph_get()))
            return submit(self, context, MergeJob(target, [moment], voxel))
        start, end = context.scene.frame_start, context.scene.frame_end
        if not 1 < end - start + 1 <= _MOST_FRAMES:
            raise ValueError(
                f"frames {start} to {end} are not a sequence: give a start and a later end, of at most {_MOST_FRAMES}"
            )
        shown = posed_on(context, person, range(start, end + 1))
        moments = [PoseSnapshot.capture(person, armature) for armature in shown]
        return submit(self, context, MergeJob(target, moments, voxel, start))


def _unmerge(person: bpy.types.Object) -> None:
    """Raises ValueError where there is no merged volume."""
    if merged_of(person) is None:
        raise ValueError(f"{person.name!r} has no merged volume")
    stop_showing(person, "MERGED")
    remove_merged(person)


class PRIMDIFFUSION_PG_merging(bpy.types.PropertyGroup):
    """`scene.primdiffusion_merging`."""

    __slots__ = ()
    voxel: bpy.props.FloatProperty(
        name="Voxel Size",
        description="Voxel size of the merged volume: half the size shows more detail and takes eight times the memory",
        subtype="DISTANCE",
        unit="LENGTH",
        default=VOXEL,
        min=0.0005,
        max=0.1,
        soft_min=0.003,
        soft_max=0.02,
        step=0.1,
        precision=4,
    )


class PRIMDIFFUSION_PT_advanced(SidebarPanel, bpy.types.Panel):
    """What a first picture does not need, in closed sections."""

    bl_label = "Advanced"
    bl_order = 4
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return bool(humans(context.scene))

    def draw(self, context: bpy.types.Context) -> None:
        _draw_person(property_columns(self.layout), context)


def _draw_person(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Sections of the selected human."""
    try:
        person = selected_person(context)
    except ValueError as error:
        draw_lines(layout, sentence(error), "INFO")
        return
    for name, text, page, section, draw in (
        ("show_as", "Show As", "rendering", "show-as", _draw_representation),
        ("merge", "Merge for Cycles", "rendering", "merge-for-cycles", _draw_merge),
        ("facts", "Facts", "editing", "facts", _draw_facts),
    ):
        if name == "merge" and not backend_is_named():
            continue
        body = draw_section(layout, name, text=text, page=page, section=section)
        if body is not None:
            draw(body, context, person)


def _draw_representation(layout: bpy.types.UILayout, _context: bpy.types.Context, person: bpy.types.Object) -> None:
    """What renders show of the human."""
    draw_representations(layout, person)
    if representation_of(person) in ("VOLUMES", "MERGED"):
        is_shown = in_viewport(person)
        icon = "RESTRICT_VIEW_OFF" if is_shown else "RESTRICT_VIEW_ON"
        text = "Hide Volumes in Viewport" if is_shown else "Show Volumes in Viewport"
        draw_job(layout, "volumes", "primdiffusion.volumes_in_viewport", icon, text=text)


def draw_representations(layout: bpy.types.UILayout, person: bpy.types.Object) -> None:
    """Buttons for what there is to choose from; the one shown is pressed."""
    now = MESH_IN_VIEWPORT if mesh_in_viewport(person) else representation_of(person)
    now = "MESH" if representation_of(person) == "MESH" else now
    without_mesh = proxy_of(person) is None
    absent = {
        "MERGED": merged_of(person) is None,
        "SPLATS": not SPLATS_AVAILABLE,
        "MESH": without_mesh,
        MESH_IN_VIEWPORT: without_mesh,
    }
    grid = layout.grid_flow(columns=2, even_columns=True, align=True)
    for name, label, _ in REPRESENTATIONS:
        if not absent.get(name):
            grid.operator("primdiffusion.set_representation", text=label, depress=name == now).representation = name


def _draw_merge(layout: bpy.types.UILayout, context: bpy.types.Context, person: bpy.types.Object) -> None:
    """One volume for Cycles."""
    layout.prop(context.scene.primdiffusion_merging, "voxel")
    draw_job(layout, "merge", "primdiffusion.merge", "VOLUME_DATA", text="Merge Pose")
    frames = draw_job(layout, "merge_frames", "primdiffusion.merge", "RENDER_ANIMATION", text="Merge Frame Range")
    frames.what = "FRAMES"
    if merged_of(person) is not None:
        if outdated(person, context.scene):
            draw_lines(layout, "The merged volume is of another pose: merge again to update it.", "ERROR")
        layout.operator("primdiffusion.merge", text="Unmerge", icon="X").what = "NOTHING"


def _draw_facts(layout: bpy.types.UILayout, _context: bpy.types.Context, person: bpy.types.Object) -> None:
    """How the human was made."""
    column = layout.column(align=True)
    for name, value in details(person):
        column.label(text=f"{name}: {value}", translate=False)


def outdated(person: bpy.types.Object, scene: bpy.types.Scene) -> bool:
    """Whether the merged volume shows another pose, shape or human than the armature as it is now."""
    try:
        return not merged_state(merged_of(person)).shows(PoseSnapshot.capture(person).digest, scene.frame_current)
    except (ValueError, OSError):  # other panels report broken bones and files
        return True


_SHOWN = ("seed", "steps", "sampler", "guidance", "checkpoint", "version")
"""Fields of the provenance, in this order."""
_MOST_LINES = 60
"""Lines about the provenance."""


def details(person: bpy.types.Object) -> list[tuple[str, str]]:
    """Names and values: how the human was made."""
    provenance = provenance_of(person)
    attributes, edits = provenance.get("attributes"), provenance.get("edits")
    shown = {name: provenance[name] for name in _SHOWN if provenance.get(name) not in (None, "")}
    lines = [(name.capitalize(), as_shown(SAMPLER_NAMES.get(str(value), value))) for name, value in shown.items()]
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
    return lines


PROPERTIES = ((bpy.types.Scene, "primdiffusion_merging", bpy.props.PointerProperty(type=PRIMDIFFUSION_PG_merging)),)
