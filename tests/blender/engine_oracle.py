"""The backend by itself, in a process of its own: makes people and draws them with `place` and `march` alone.

Speaks JSON, an object a line: {"make": folder, "seed": 0, "betas": [...]}, {"place": {...}, "out": npz} (a posed
person's boxes) or {"draw": {...}, "out": npz}, where {"boxes": npz} may stand for a person;
"compose" instead of "draw" adds solids and a background; answers {}.
Run by the backend's Python; Blender's tests compare the engine's pictures with it.
"""

import json
import sys
from pathlib import Path

import numpy as np
import torch
from primdiffusion.body.model import BodyPose, default_body
from primdiffusion.drawing import Scene, ViewSettings
from primdiffusion.drawing import draw as compose_scene
from primdiffusion.editing.reshaping import reshape_human
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.textured_mesh import TexturedMesh, TexturedPart
from primdiffusion.human import Human, place
from primdiffusion.human_file import load_human, save_human
from primdiffusion.primitives.anchors import attach, default_anchors
from primdiffusion.primitives.from_mesh import from_mesh
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.lattice import MarchSettings
from primdiffusion.render.march import Span, march
from primdiffusion.render.solids import Solids


def make(folder: Path, seed: int, betas: list[float]) -> None:
    """A person in a random checkered suit: person.human.safetensors in `folder`."""
    body, shape = default_body(), torch.tensor(betas)
    vertices = body.shape(shape).vertices
    frames = attach(default_anchors(), vertices, body.faces)
    cells = np.random.default_rng(seed).integers(40, 230, (32, 32, 4), dtype=np.uint8)
    texture = cells.repeat(8, axis=0).repeat(8, axis=1)
    texture[..., 3] = 255
    skin = TexturedPart(
        name="body",
        vertices=vertices.double().numpy(),
        faces=body.faces.int().numpy(),
        corner_uv=body.uv[body.uv_faces].double().numpy(),
        texture=texture,
        skin_index=np.zeros((len(vertices), 1), np.int32),
        skin_weight=np.ones((len(vertices), 1)),
    )
    human = Human(from_mesh(TexturedMesh((skin,)), frames), shape, {"seed": seed, "full_density": 100.0})
    folder.mkdir(parents=True, exist_ok=True)
    save_human(folder / "person.human.safetensors", human)


def placed(
    folder: str, rotations: list, translation: list, world: list, betas: list | None = None, **_: object
) -> Primitives:
    """A posed person, of other betas if given, then moved, turned and scaled alike in all directions by `world`."""
    human = load_human(Path(folder) / "person.human.safetensors")
    if betas is not None:
        human = reshape_human(human, torch.tensor(betas))
    pose = BodyPose(torch.tensor(rotations, dtype=torch.float32), torch.tensor(translation, dtype=torch.float32))
    person, matrix = place(human, pose), torch.tensor(world, dtype=torch.float64)
    scale = float(torch.linalg.det(matrix[:3, :3])) ** (1 / 3)
    turn = (matrix[:3, :3] / scale).float()
    return Primitives(
        position=(scale * person.position) @ turn.T + matrix[:3, 3].float(),
        rotation=turn @ person.rotation,
        half_extent=scale * person.half_extent,
        rgb=person.rgb,
        density=person.density / scale,
    )


def boxes(file: str) -> Primitives:
    """Boxes from an npz of their fields."""
    with np.load(file) as fields:
        return Primitives(**{name: torch.from_numpy(fields[name]) for name in fields.files})


def draw(
    out: str,
    people: list,
    intrinsics: list,
    world_to_camera: list,
    width: int,
    height: int,
    step: float,
    clip: list | None = None,
    strides: list = (4, 2, 1),
) -> None:
    """Combined [h, w, 4] and depth along the optical axis [h, w], top row first; `clip` is along that axis."""
    primitives = Primitives.together(
        [boxes(person["boxes"]) if "boxes" in person else placed(**person) for person in people]
    )
    matrices = (torch.tensor(matrix, dtype=torch.float32) for matrix in (intrinsics, world_to_camera))
    camera = Camera(*matrices, width, height)
    cosine = camera.rays()[1] @ camera.world_to_camera[2, :3]
    span = None if clip is None else Span(clip[0] / cosine, clip[1] / cosine)
    rendering = march(primitives, camera, MarchSettings(step=step, strides=tuple(strides)), span=span)
    depth = (rendering.first_hit * cosine).numpy()
    depth[~np.isfinite(depth)] = 1e10
    np.savez(out, combined=np.concatenate([rendering.rgb, rendering.alpha[..., None]], -1), depth=depth)


def compose(
    out: str, people: list, solids: dict, background: list | None, intrinsics: list, world_to_camera: list,
    width: int, height: int, clip: list,
) -> None:  # fmt: skip
    """Combined [h, w, 4] and depth [h, w] of people among solids, as the child draws them."""
    primitives = Primitives.together([boxes(person["boxes"]) for person in people])
    matrices = (torch.tensor(matrix, dtype=torch.float32) for matrix in (intrinsics, world_to_camera))
    arrays = (np.array(solids[name], dtype) for name, dtype in (("corners", "f4"), ("colour", "f4"), ("holdout", "?")))
    look = ViewSettings("colour", None if background is None else tuple(background), tuple(clip))
    picture = compose_scene(Scene(primitives, Solids(*arrays)), Camera(*matrices, width, height), look)
    np.savez(out, combined=picture.rgba, depth=picture.depth)


for line in sys.stdin:
    request = json.loads(line)
    if "make" in request:
        make(Path(request["make"]), request["seed"], request["betas"])
    elif "place" in request:
        np.savez(request["out"], **{name: tensor.numpy() for name, tensor in vars(placed(**request["place"])).items()})
    elif "compose" in request:
        compose(request["out"], **request["compose"])
    else:
        draw(request["out"], **request["draw"])
    print("{}", flush=True)
