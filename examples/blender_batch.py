"""Everything by script: open a file, generate two people, pose one, move the other, render, save.

blender -b shot.blend --python examples/blender_batch.py -- --out rendered        # the extension enabled
python examples/blender_batch.py --blend shot.blend --out rendered                # Blender as a Python module
"""

import argparse
import sys
from pathlib import Path

import bpy


def main(words: list[str]) -> None:
    """Writes people.blend and a picture of each asked-for frame; any operator that fails raises RuntimeError."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--blend", type=Path, help="the file to begin with; not given: the open one")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, nargs=2, default=(7, 8))
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--motion", type=Path, help="of the second person: AMASS .npz, .bvh ...; not given: a walk")
    parser.add_argument("--frames", type=int, nargs="+", default=[1, 12])
    parser.add_argument("--size", type=int, nargs=2, default=(640, 480))
    arguments = parser.parse_args(words)
    if arguments.blend is not None:
        bpy.ops.wm.open_mainfile(filepath=str(arguments.blend))
    people = bpy.ops.primdiffusion
    scene, out = bpy.context.scene, arguments.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(out / "people.blend"))  # people's files go beside it

    for place, seed in zip((-0.6, 0.6), arguments.seeds, strict=True):
        before = set(everybody())
        people.generate(seed=seed, steps=arguments.steps, count=1)
        (person,) = set(everybody()) - before
        person.name = f"Person {seed}"
        armature_of(person).location.x = place
    first, second = (bpy.data.collections[f"Person {seed}"] for seed in arguments.seeds)

    select(armature_of(first))
    people.apply_pose(pose_name="Waving")
    select(armature_of(second))
    if arguments.motion is not None:
        people.import_motion(filepath=str(arguments.motion))
    else:
        people.add_motion(motion="WALK")

    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(camera)
    camera.location, camera.rotation_euler = (0.0, -6.0, 1.0), (1.5708, 0.0, 0.0)
    scene.camera = camera
    scene.render.engine = "PRIMDIFFUSION"
    scene.render.resolution_x, scene.render.resolution_y = arguments.size
    for frame in arguments.frames:
        scene.frame_set(frame)
        scene.render.filepath = str(out / f"{frame:04d}.png")
        bpy.ops.render.render(write_still=True)
    bpy.ops.wm.save_mainfile()


def everybody() -> list[bpy.types.Collection]:
    """The people of the file."""
    return [collection for collection in bpy.data.collections if "primdiffusion_human" in collection]


def armature_of(person: bpy.types.Collection) -> bpy.types.Object:
    """What is posed, moved and placed."""
    return next(thing for thing in person.objects if thing.type == "ARMATURE")


def select(thing: bpy.types.Object) -> None:
    """Whom the next operators are about."""
    bpy.context.view_layer.objects.active = thing


if __name__ == "__main__":
    if not bpy.app.binary_path and not hasattr(bpy.types, "PRIMDIFFUSION_OT_generate"):
        sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
        import blender_primdiffusion

        blender_primdiffusion.register()
    main(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:])
