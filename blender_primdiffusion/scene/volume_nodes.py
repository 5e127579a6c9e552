"""The volumes of a human as one object, whose node group shows a VDB file for each primitive on the skinned body; their
material: emission and absorption driven by the density grid, times a gain; Cycles' settings for them; and the files, a
bake that may be deleted.

The files lie beside the human's own file in the temporary folder of this session (see `payload`). A .blend that comes
from another session, or from a stranger, names folders of its own: `open_humans` names this session's before anything
is read.
"""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path

import bpy

from ..files.whole_files import remove_abandoned
from ..formats.requests import DENSITY_GAIN
from .cells import FIRST, PRIMITIVE, NodeGroup, add_nodes, cell_mesh, set_input, shared_group
from .human import all_humans, body_of, link_part, parts_of, session_file, write_error
from .human_file import read_human, shape_model_of
from .shape import betas_of, generated_betas
from .volumes import write_volume

VOLUMES_MARK = "primdiffusion_volumes"
"""Custom property of the object of a human that shows its volumes."""
IN_VIEWPORT = "primdiffusion_volumes_in_viewport"
"""Custom property of a human: whether viewports show its volumes, too."""
GROUP_NAME = "PrimDiffusion Volumes on Body"
BODY, FOLDER, MATERIAL = "Body", "Folder", "Material"
"""Inputs of the group."""
MODIFIER = "Volumes on Body"
FILES = "prim_{:04}.vdb"
"""Names of the files, by primitive."""


def build_volumes(person: bpy.types.Object) -> bpy.types.Object:
    """Give a human the object, hidden in views; writes no files.

    Raises as `shape_model_of` and `session_file`, and ValueError where the body mesh was deleted. Makes no undo step.
    """
    model, body, betas = shape_model_of(person), body_of(person), betas_of(person)
    if body is None:
        raise ValueError(f"the body mesh of {person.name!r} was deleted: undo that, or generate the human again")
    mesh = cell_mesh(f"{person.name}_volumes", model, betas, model.growth(generated_betas(person), betas))
    volumes = bpy.data.objects.new(mesh.name, mesh)
    volumes.hide_viewport = True
    volumes[VOLUMES_MARK] = True
    volumes.parent = person
    link_part(person, volumes)
    add_nodes(volumes, MODIFIER, _volume_group(), {BODY: body, MATERIAL: volume_material()})
    set_folder(person, session_file(person).parent)
    return volumes


def volumes_of(person: bpy.types.Object) -> bpy.types.Object | None:
    """The object that shows the human's volumes; None for humans without."""
    return next((obj for obj in parts_of(person) if VOLUMES_MARK in obj), None)


def hide_in_viewport(person: bpy.types.Object, volumes: bpy.types.Object) -> None:
    """Hide the human's volumes in viewports. Those of a linked human or an override come back with the next loading."""
    volumes.hide_viewport = True
    if person.library is None and person.override_library is None:
        person[IN_VIEWPORT] = False


def set_folder(person: bpy.types.Object, folder: Path, *, again: bool = False) -> None:
    """Have a human's volumes show the files of this folder.

    Blender remembers for the whole session which files were missing. With `again` the folder is spelled in another way,
    for which Blender looks for the files anew.
    """
    volumes = volumes_of(person)
    modifier = volumes.modifiers.get(MODIFIER) if volumes is not None else None
    if modifier is not None and modifier.node_group is not None:
        set_input(modifier, FOLDER, f"{folder}/." if again else str(folder))
        volumes.update_tag(refresh={"DATA"})


def _volume_group() -> bpy.types.NodeTree:
    """The shared node group, made on first use."""
    about = "Shows a folder of volumes, one for each box of a human, on its body"
    return shared_group(GROUP_NAME) or _build(NodeGroup(GROUP_NAME, about))


def _build(group: NodeGroup) -> bpy.types.NodeTree:
    group.socket("Cells", "INPUT", "NodeSocketGeometry")
    group.socket(BODY, "INPUT", "NodeSocketObject", "The human's body mesh, which its armature bends")
    group.socket(FOLDER, "INPUT", "NodeSocketString", "The folder of the VDB files, with its whole path")
    group.socket(MATERIAL, "INPUT", "NodeSocketMaterial", "The material of the volumes")
    group.socket("Volumes", "OUTPUT", "NodeSocketGeometry")
    node = group.node
    inputs = node("NodeGroupInput").outputs
    centre, rotation, scale = group.frames(group.geometry_of(inputs[BODY]))
    first = group.attribute(FIRST, "BOOLEAN")
    cells = {"Geometry": inputs["Cells"], "Selection": first}
    each, end = node("GeometryNodeForeachGeometryElementInput"), node("GeometryNodeForeachGeometryElementOutput")
    each.pair_with_output(end)
    group.put(each.inputs["Geometry"], node("GeometryNodeSeparateGeometry", cells, domain="POINT").outputs[0])
    path = node("FunctionNodeFormatString", {"Format": f"{{}}/{FILES}"})
    path.format_items.new("STRING", "Folder")
    path.format_items.new("INT", "Primitive")
    group.put(path.inputs["Folder"], inputs[FOLDER])
    group.put(path.inputs["Primitive"], each.outputs["Index"])
    volume = node("GeometryNodeImportVDB", {"Path": path.outputs[0]}).outputs[0]
    volume = node("GeometryNodeSetMaterial", {"Geometry": volume, "Material": inputs[MATERIAL]}).outputs[0]
    made = [socket for socket in end.inputs if socket.name == "Geometry"][-1]
    group.put(made, node("GeometryNodeGeometryToInstance", {0: volume}).outputs[0])
    instances = node(
        "GeometryNodeInstanceOnPoints",
        {
            "Points": node("GeometryNodeSetPosition", {"Geometry": inputs["Cells"], "Position": centre}).outputs[0],
            "Selection": first,
            "Instance": [socket for socket in end.outputs if socket.name == "Geometry"][-1],
            "Pick Instance": True,
            "Instance Index": group.attribute(PRIMITIVE, "INT"),
            "Rotation": rotation,
            "Scale": scale,
        },
    )
    group.put(node("NodeGroupOutput").inputs["Volumes"], instances.outputs["Instances"])
    return group.tree


MATERIAL_NAME = "PrimDiffusion Volume"
GAIN_NODE = "Density Gain"


def volume_material() -> bpy.types.Material:
    """The shared material, made on first use.

    With s = gain * density, at first DENSITY_GAIN: emission of strength s and colour Cd, absorption of density s in
    black, so that a ray integrates Cd s exp(-integral of s): premultiplied colour.
    """
    existing = bpy.data.materials.get(MATERIAL_NAME)
    if existing is not None and GAIN_NODE in existing.node_tree.nodes:
        return existing
    material = bpy.data.materials.new(MATERIAL_NAME)
    tree = material.node_tree
    tree.nodes.clear()

    def node(kind: str, x: float, y: float, **values: object) -> bpy.types.Node:
        made = tree.nodes.new(kind)
        made.location = (x, y)
        for key, value in values.items():
            setattr(made, key, value)
        return made

    colour = node("ShaderNodeAttribute", -600, 200, attribute_name="Cd")
    density = node("ShaderNodeAttribute", -600, 0, attribute_name="density")
    factor = node("ShaderNodeValue", -600, -200, name=GAIN_NODE, label=GAIN_NODE)
    factor.outputs[0].default_value = DENSITY_GAIN
    strength = node("ShaderNodeMath", -400, 0, operation="MULTIPLY")
    emission = node("ShaderNodeEmission", -200, 100)
    absorption = node("ShaderNodeVolumeAbsorption", -200, -100)
    absorption.inputs["Color"].default_value = (0.0, 0.0, 0.0, 1.0)
    both = node("ShaderNodeAddShader", 0, 0)
    output = node("ShaderNodeOutputMaterial", 200, 0)
    for source, target in (
        (density.outputs["Fac"], strength.inputs[0]),
        (factor.outputs[0], strength.inputs[1]),
        (colour.outputs["Color"], emission.inputs["Color"]),
        (strength.outputs[0], emission.inputs["Strength"]),
        (strength.outputs[0], absorption.inputs["Density"]),
        (emission.outputs[0], both.inputs[0]),
        (absorption.outputs[0], both.inputs[1]),
        (both.outputs[0], output.inputs["Volume"]),
    ):
        tree.links.new(source, target)
    return material


def open_humans() -> list[str]:
    """Point the volumes of all humans to the files of this session; returns what is wrong with humans, in sentences.

    For files that were opened and humans that were appended or linked, before undo takes note of them. A human whose
    data are missing or damaged shows its body mesh. Viewports hide volumes whose files are yet to be written: Blender
    would remember that they were missing (see `set_folder`).
    """
    faults = []
    for person in all_humans():
        try:
            folder = session_file(person).parent
            shape_model_of(person)
        except (ValueError, OSError) as error:
            faults.append(f"the human {person.name!r} cannot be drawn: {error}")
            if (body := body_of(person)) is not None:
                body.hide_viewport = False
            continue
        set_folder(person, folder)
        volumes = volumes_of(person)
        if volumes is not None and not volumes.hide_viewport and not are_written(person):
            hide_in_viewport(person, volumes)
    return faults


def files_of(person: bpy.types.Object) -> list[Path]:
    """Where the files of a human's volumes are, or will be. Raises as `session_file` and `shape_model_of`."""
    folder, count = session_file(person).parent, len(shape_model_of(person).face)
    return [folder / FILES.format(k) for k in range(count)]


def are_written(person: bpy.types.Object) -> bool:
    """Whether all files of a human's volumes are there. Raises as `files_of`."""
    return all(path.is_file() for path in files_of(person))


def writing(person: bpy.types.Object) -> Generator[None, None, None]:
    """Write the files of a human's volumes, one a step; those that are there stay. It holds no Blender objects, since
    undo may replace them. Raises as `read_human`, also for what cannot be written.
    """
    return _writing(session_file(person), files_of(person))


def _writing(source: Path, files: list[Path]) -> Generator[None, None, None]:
    grids = read_human(source).grids()
    yield
    remove_abandoned(source.parent)
    for k, path in enumerate(files):
        try:
            if not path.is_file():
                write_volume(grids, k, path)
        except (OSError, RuntimeError) as error:  # openvdb reports a full disk as RuntimeError
            raise write_error(source.parent, error) from error
        yield


def write_volumes(person: bpy.types.Object) -> None:
    """Write the files of a human's volumes, which takes seconds. Raises as `writing`."""
    if volumes_of(person) is not None and not are_written(person):
        for _ in writing(person):
            pass


def fit_cycles_to_volumes(scene: bpy.types.Scene, samples: int) -> None:
    """Set Cycles up so that a human takes minutes, not hours: other objects lose indirect light."""
    cycles = scene.cycles
    cycles.samples = samples
    cycles.use_adaptive_sampling = False
    cycles.use_denoising = False
    cycles.max_bounces = 0
    cycles.volume_bounces = 0
    cycles.transparent_max_bounces = 1024  # every box in a row costs two
    cycles.volume_step_rate = 1.0
    cycles.volume_biased = True  # unbiased tracking takes seconds per volume object, an hour a frame
