"""Small people and captures for tests: boxes that follow two joints, drawn from few sides."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from primdiffusion.body.model import default_body
from primdiffusion.capture.poses import built_in_poses
from primdiffusion.capture.render import PASSES, RenderJob, render
from primdiffusion.formats.camera_rig import Rig
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.geometry.textured_mesh import TexturedMesh, TexturedPart
from primdiffusion.people.gltf import Skeleton, glb

LEFT_WRIST = JOINT_NAMES.index("left_wrist")
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
FACES = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
         [1, 5, 7], [1, 7, 3]]  # fmt: skip
RED, GREEN, BLUE, WHITE = (255, 0, 0, 255), (0, 255, 0, 255), (0, 0, 255, 255), (255, 255, 255, 255)


def box(name="box", centre=(0, 0, 0), half=0.5, colour=RED, joint=0) -> TexturedPart:
    """A cube of one colour."""
    return TexturedPart(
        name=name,
        vertices=CORNERS * half + np.asarray(centre, np.float64),
        faces=np.array(FACES, np.int32),
        corner_uv=np.full((12, 3, 2), 0.5, np.float32),
        texture=np.array([[colour]], np.uint8),
        skin_index=np.full((8, 4), joint, np.int32),
        skin_weight=np.tile([1.0, 0, 0, 0], (8, 1)),
    )


def square(texture, z=0.0, side=1.0) -> TexturedPart:
    """An upright square that faces +z, its texture upright as seen from there."""
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return TexturedPart(
        name="square",
        vertices=np.c_[(uv - 0.5) * side, np.full(4, z)],
        faces=faces,
        corner_uv=uv[faces].astype(np.float32),
        texture=np.asarray(texture, np.uint8),
        skin_index=np.zeros((4, 1), np.int32),
        skin_weight=np.ones((4, 1)),
    )


def box_person() -> TexturedMesh:
    """A body of one box, and one about the left wrist."""
    joints = default_body().shape(torch.zeros(1)).joints.numpy()
    return TexturedMesh((box("body", half=0.3), box("hand", joints[LEFT_WRIST], 0.1, BLUE, LEFT_WRIST)))


def body_mesh(texture=((WHITE,),)) -> TexturedMesh:
    """The default body without clothes, each vertex on its four strongest joints."""
    body = default_body()
    weight, index = body.skin_weights.topk(4, dim=1)
    return TexturedMesh((
        TexturedPart(
            name="body",
            vertices=body.template.double().numpy(),
            faces=body.faces.int().numpy(),
            corner_uv=body.uv[body.uv_faces].float().numpy(),
            texture=np.asarray(texture, np.uint8),
            skin_index=index.numpy().astype(np.int32),
            skin_weight=(weight / weight.sum(1, keepdim=True)).double().numpy(),
        ),
    ))  # fmt: skip


def save_person(path: Path, mesh: TexturedMesh | None = None, betas: Sequence[float] = (0.0,) * 10) -> Path:
    """A person's .glb."""
    body = default_body()
    skeleton = Skeleton(JOINT_NAMES, body.parents.tolist(), body.shape(torch.tensor(betas)).joints.double().numpy())
    extras = {"primdiffusion": {"betas": list(betas), "body": "default", "seed": 0}}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(glb(mesh or box_person(), skeleton, extras))
    return path


def small_job(root: Path, people: int = 2, frames: int = 3, passes=PASSES, **more) -> RenderJob:
    """Boxes in `frames` poses from 4 sides, 32 pixels wide."""
    paths = {f"person_{i:06d}": save_person(root / "people" / f"person_{i:06d}" / "person.glb") for i in range(people)}
    poses = built_in_poses().map(lambda values: values[:frames])
    return RenderJob(paths, poses, root / "captures", Rig("sphere", 4, width=32, height=32), passes, **more)


def captured(root: Path, **more) -> Path:
    """A folder of such captures."""
    job = small_job(root, **more)
    assert {outcome.status for outcome in render(job)} == {"done"}
    return job.out


def decoded(counts: list[int], height: int, width: int) -> np.ndarray:
    """A mask from COCO's run lengths, without pycocotools."""
    return np.repeat(np.arange(len(counts)) % 2 == 1, counts).reshape(width, height).T
