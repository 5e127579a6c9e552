"""Everything in a script: open a file, generate two people, pose one, animate the other, render, save.

blender -b shot.blend --python examples/blender_batch.py -- --out rendered        # with the extension enabled
python examples/blender_batch.py --blend shot.blend --out rendered                # Blender as a Python module
"""

import argparse
import sys
from pathlib import Path

import bpy


def main(options: list[str]) -> None:
    """Writes people.blend and a picture of each frame; raises RuntimeError if an operator fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--blend", type=Path, help="the file to begin with; not given: the open one")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, nargs=2, default=(7, 8))
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--motion", type=Path, help="for the second person: AMASS .npz, .bvh, ...; default: a walk")
    parser.add_argument("--frames", type=int, nargs="+", default=[1, 12])
    parser.add_argument("--size", type=int, nargs=2, default=(640, 480))
    arguments = parser.parse_args(options)
    if arguments.blend is not None:
        bpy.ops.wm.open_mainfile(filepath=str(arguments.blend))
    operators = bpy.ops.primdiffusion
    scene, out = bpy.context.scene, arguments.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(out / "people.blend"))

    scene.primdiffusion.steps = arguments.steps
    for x, seed in zip((-0.6, 0.6), arguments.seeds, strict=True):
        before = set(humans())
        operators.generate(seed=seed)
        (person,) = set(humans()) - before
        person.name = f"Person {seed}"
        person.location.x = x
    first, second = (bpy.data.objects[f"Person {seed}"] for seed in arguments.seeds)

    pose(first, "Waving")
    select(second)
    if arguments.motion is not None:
        operators.import_motion(filepath=str(arguments.motion))
    else:
        operators.add_motion(motion="WALK")

    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(camera)
    camera.location, camera.rotation_euler = (0.0, -6.0, 1.0), (1.5708, 0.0, 0.0)
    scene.camera = camera
    scene.render.engine = "PRIMDIFFUSION"
    scene.render.resolution_x, scene.render.resolution_y = arguments.size
    for frame in arguments.frames:
        scene.frame_set(frame)
        bpy.ops.render.render()  # without write_still: in render.filepath, Blender 5 takes {braces} for templates
        bpy.data.images["Render Result"].save_render(str(out / f"{frame:04d}.png"))
    bpy.ops.wm.save_mainfile()


def humans() -> list[bpy.types.Object]:
    """The people in the file: armatures, which are posed, moved and animated."""
    return [obj for obj in bpy.data.objects if "primdiffusion_human" in obj]


def pose(person: bpy.types.Object, name: str) -> None:
    """Apply a pose asset of the extension, as Blender's pose library does."""
    library = bpy.context.preferences.filepaths.asset_libraries["PrimDiffusion"]
    with bpy.data.libraries.load(str(Path(library.path) / "poses.blend")) as (_, wanted):
        wanted.actions = [name]
    person.pose.apply_pose_from_action(wanted.actions[0])


def select(obj: bpy.types.Object) -> None:
    """Select the person for the next operators."""
    bpy.context.view_layer.objects.active = obj


if __name__ == "__main__":
    if not bpy.app.binary_path and not hasattr(bpy.types, "PRIMDIFFUSION_OT_generate"):
        sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
        import blender_primdiffusion

        blender_primdiffusion.register()
    main(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:])
