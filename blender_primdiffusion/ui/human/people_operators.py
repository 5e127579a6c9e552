"""Select, Frame, Duplicate and Delete Human: people as wholes."""

from __future__ import annotations

import bpy

from ...scene.human import armature_of, remove_human
from ..jobs.target import named_person, selected_person

_HUMAN = "Name of the person (of their collection); empty: the selected one"


class _Whole:
    """What these operators have in common."""

    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    human: bpy.props.StringProperty(name="Person", description=_HUMAN, options={"SKIP_SAVE"})

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Reports why it cannot be done."""
        try:
            self.do(context, self.meant(context))
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}

    def meant(self, context: bpy.types.Context) -> bpy.types.Collection:
        """Whom this is about. Raises ValueError."""
        return named_person(context, self.human) if self.human else selected_person(context)

    def do(self, context: bpy.types.Context, person: bpy.types.Collection) -> None:
        """Raises ValueError with a sentence."""
        raise NotImplementedError


class PRIMDIFFUSION_OT_select_human(_Whole, bpy.types.Operator):
    """Make the armature of this person the active object, and the only one selected"""

    bl_idname = "primdiffusion.select_human"
    bl_label = "Select Human"

    def do(self, context: bpy.types.Context, person: bpy.types.Collection) -> None:
        """The panels then speak of this person."""
        select(context, person)


class PRIMDIFFUSION_OT_frame_human(_Whole, bpy.types.Operator):
    """Select this person and move the view so that they fill it"""

    bl_idname = "primdiffusion.frame_human"
    bl_label = "Frame Human"

    def do(self, context: bpy.types.Context, person: bpy.types.Collection) -> None:
        """In the 3D viewport that this was pressed in, else in the first."""
        place = _viewport(context)
        if place is None:
            raise ValueError("no 3D viewport is open to show the person in: open one")
        select(context, person)
        with context.temp_override(**place):
            bpy.ops.view3d.view_selected()


class PRIMDIFFUSION_OT_duplicate_human(_Whole, bpy.types.Operator):
    """Put another person like this one beside them: bones and body of their own, the same files"""

    bl_idname = "primdiffusion.duplicate_human"
    bl_label = "Duplicate Human"

    def do(self, context: bpy.types.Context, person: bpy.types.Collection) -> None:
        """The new person is selected."""
        from ...scene.build import stand_beside_others
        from ...scene.duplicate import duplicate_human
        from ...scene.human import check_editable
        from ...scene.painting import leave_mode

        check_editable(person)
        leave_mode(context)
        twin = duplicate_human(person)
        context.view_layer.update()
        stand_beside_others(context, twin)
        select(context, twin)


class PRIMDIFFUSION_OT_delete_human(_Whole, bpy.types.Operator):
    """Remove this person from the scene; their files stay on disk for Undo, until Remove Unused Files"""

    bl_idname = "primdiffusion.delete_human"
    bl_label = "Delete Human"
    bl_options = {"UNDO"}  # noqa: RUF012  nothing to redo

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask first."""
        try:
            title = f"Delete {self.meant(context).name}?"
        except ValueError:
            return self.execute(context)
        message = "Their files stay on disk for Undo: Files > Remove Unused Files deletes them"
        return context.window_manager.invoke_confirm(self, event, title=title, message=message)

    def do(self, context: bpy.types.Context, person: bpy.types.Collection) -> None:
        """Linked people are unlinked by the Outliner, not here: they belong to another file."""
        from ...scene.grid_cache import free_unused_grids
        from ...scene.painting import leave_mode

        if person.library is not None:
            raise ValueError(f"the person {person.name!r} is linked: remove them in the Outliner, by Unlink")
        leave_mode(context)
        remove_human(person)
        context.view_layer.update()  # what is evaluated holds grids too
        free_unused_grids()


def select(context: bpy.types.Context, person: bpy.types.Collection) -> None:
    """Make a person's armature active. Raises ValueError for one that cannot be selected in this view layer."""
    from ...scene.painting import leave_mode

    armature = armature_of(person)
    if context.view_layer.objects.get(armature.name) != armature:
        raise ValueError(f"the armature of {person.name!r} is not in this view layer: enable their collection first")
    leave_mode(context)
    for thing in context.view_layer.objects.selected:
        thing.select_set(False)
    armature.select_set(True)
    context.view_layer.objects.active = armature


def _viewport(context: bpy.types.Context) -> dict[str, object] | None:
    windows = [context.window] if context.window else list(context.window_manager.windows)
    areas = [(window, area) for window in windows for area in window.screen.areas if area.type == "VIEW_3D"]
    for window, area in sorted(areas, key=lambda found: found[1] != context.area):
        region = next(region for region in area.regions if region.type == "WINDOW")
        return {"window": window, "area": area, "region": region}
    return None


PEOPLE = (
    PRIMDIFFUSION_OT_select_human,
    PRIMDIFFUSION_OT_frame_human,
    PRIMDIFFUSION_OT_duplicate_human,
    PRIMDIFFUSION_OT_delete_human,
)
