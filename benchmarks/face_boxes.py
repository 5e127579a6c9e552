"""Cost and gain of 256 more boxes on the face: a grid of 16 x 16, each half as large as the boxes of the body.

`python benchmarks/face_boxes.py --assets DIR --json F --sheet F.png` fits payloads of held-out humans (those of
benchmarks/chain.py) to renders of their meshes in the rest pose, without and with the face grid, from the same cameras:

    body          1024 boxes, as `payloads` makes them
    more          1024 + 256
    instead       960 + 256: the grid replaces the 64 boxes of the body under it

`db` is the `psnr` of benchmarks/chain.py, `hf` its fine energy (1 in the mesh): `head` from the chain's camera, `face`
from one that spans 0.2 m, both 256 x 256, means over humans; `more_head_gain_db_min` is the smallest gain of a human.
Ratios are processor times over those of `body`: `fit` of whole fits, `march_body` of the chain's front view (512 x 512)
and `march_head` of its head view, medians of alternating calls. Megabytes (10^6) of a human: `payload` in memory
(float32), `human_file` and `compact_human_file` without metadata, `engine_texture` on the GPU (half floats, RGBA).
"""

from __future__ import annotations

import collections
import dataclasses
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from chain import compare, over_grey
from chain_sets import HEAD_YAW, draw, held_out, rest_scene
from PIL import Image
from primdiffusion.body.model import default_body
from primdiffusion.files import tensor_file
from primdiffusion.formats.human_layout import (
    to_eight_bits,
)
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.surface import surface_points
from primdiffusion.people.assets import open_assets
from primdiffusion.people.payloads import HEAD_FOV, SUPERSAMPLE, orbit_camera, rest_frames, views_of
from primdiffusion.people.person import Person
from primdiffusion.people.wardrobe import required_meshes
from primdiffusion.primitives.anchors import default_texels
from primdiffusion.primitives.from_mesh import FULL_DENSITY, from_mesh
from primdiffusion.primitives.primitives import GRID, Frames, K, Payload, Primitives, S
from primdiffusion.raster.rasterise import rasterise
from primdiffusion.render.image import PosedView
from primdiffusion.render.inverse import fit_colours, fit_payload
from primdiffusion.render.march import march
from record import command_line, report
from torch import Tensor

ROW, COLUMN, CELLS = 22, 12, 8
"""The square of the body's grid from chin to hairline and from temple to temple."""
SPLIT = 2  # boxes along a side of a cell
THICKNESS = 0.5
"""Half extent along the normal relative to the body's boxes."""
FACE_EXTENT = 0.2  # metres
HALF_FLOAT_VOXEL = 8
"""Bytes of a voxel in the engine's texture."""
CALLS = 15

Figures = dict[str, float | int | bool | str | None]


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--assets", type=Path, help="MakeHuman asset folder (or PRIMDIFFUSION_ASSETS)")
    parser.add_argument("--people", type=int, default=6, help="held-out humans")
    parser.add_argument("--sheet", type=Path, help="PNG of heads: mesh, body, more, instead; a row per human")
    arguments = parser.parse_args()
    assets = open_assets(arguments.assets, required_meshes())
    measured: dict[str, list[float]] = collections.defaultdict(list)
    rows: list[np.ndarray] = []
    figures: Figures = {"boxes": K, "face_boxes": (CELLS * SPLIT) ** 2}
    for number in range(arguments.people):
        rows.append(np.concatenate(measure(held_out(assets, number), measured), axis=1))
        gains = np.subtract(measured["more_head_db"], measured["body_head_db"])
        figures |= {"people": number + 1, "more_head_gain_db_min": round(float(gains.min()), 4)}
        figures |= {name: round(float(np.mean(values)), 4) for name, values in measured.items()}
        report(figures, arguments.json)  # what is known so far: the rest takes long
    if arguments.sheet is not None:
        Image.fromarray(np.concatenate(rows)).save(arguments.sheet)


def measure(person: Person, measured: dict[str, list[float]]) -> list[np.ndarray]:
    """Add the figures of one human to `measured`; return pictures of its head: mesh, body, more, instead."""
    scene, body = rest_scene(person), rest_frames(person.betas)
    face = face_frames(person.betas, body)
    layouts = {
        "body": body,
        "more": joined(body, face),
        "instead": joined(body.map(lambda tensor: tensor[~covered()]), face),
    }
    head, middle = scene.cameras["head"], face.position.double().mean(0).numpy()
    views = {"head": head, "face": orbit_camera(middle, FACE_EXTENT, HEAD_YAW, 0, HEAD_FOV, head.width)}
    scene = dataclasses.replace(scene, cameras={**scene.cameras, **views})
    true, shown, boxes, seconds = {view: scene.true(view) for view in views}, [], {}, {}
    images = images_of(person)
    for name, frames in layouts.items():
        targets = [PosedView(frames, *image) for image in images]
        start = from_mesh(person.mesh, frames)
        fit_payload(start, targets[:1], FULL_DENSITY)  # the first compiles
        begun = time.process_time()
        fitted = fit_payload(start, targets, FULL_DENSITY)
        (fitted,) = fit_colours([fitted], fitted, [targets])
        seconds[name], boxes[name] = time.process_time() - begun, Primitives.place(frames, fitted)
        for view, camera in views.items():
            drawn = draw(frames, fitted, camera)
            result = compare(drawn, true[view])
            measured[f"{name}_{view}_db"].append(result["psnr"])
            measured[f"{name}_{view}_hf"].append(result["hf"])
            shown += [drawn] * (view == "head")
        for kind, count in sizes(fitted, person.betas).items():
            measured[f"{name}_{kind}_mb"].append(count / 1e6)
    for name in ("more", "instead"):
        measured[f"{name}_fit_ratio"].append(seconds[name] / seconds["body"])
        for view, camera in (("body", scene.cameras["front"]), ("head", head)):
            measured[f"{name}_march_{view}_ratio"].append(march_ratio(boxes["body"], boxes[name], camera))
    return [(over_grey(picture).numpy() * 255).round().astype(np.uint8) for picture in (true["head"], *shown)]


def face_frames(betas: np.ndarray, body: Frames) -> Frames:
    """The face grid in the rest pose, on the texels of the body's layout under the square of its cells."""
    model = default_body()
    vertices = model.shape(torch.as_tensor(betas, dtype=model.template.dtype)).vertices
    square = slice(ROW * S, (ROW + CELLS) * S), slice(COLUMN * S, (COLUMN + CELLS) * S)
    faces, barycentric = (texels[square] for texels in default_texels())
    points = surface_points(vertices.float(), model.faces, faces.flatten(), barycentric.flatten(0, 1))
    side = S // SPLIT
    cells = points.reshape(CELLS * SPLIT, side, CELLS * SPLIT, side, 3).transpose(1, 2).flatten(0, 1)
    to_width = side / (side - 1)
    du = (cells[:, :, -1] - cells[:, :, 0]).mean(1) * to_width
    dv = (cells[:, -1] - cells[:, 0]).mean(1) * to_width
    tangent = torch.nn.functional.normalize(du, dim=-1)
    normal = torch.nn.functional.normalize(torch.linalg.cross(tangent, dv), dim=-1)
    rotation = torch.stack([tangent, torch.linalg.cross(normal, tangent), normal], -1)
    thickness = torch.full((len(cells),), THICKNESS * float(body.half_extent[covered(), 2].mean()))
    return Frames(cells.mean((1, 2)), rotation, torch.stack([du.norm(dim=-1), dv.norm(dim=-1), thickness], -1))


def covered() -> Tensor:
    """The body's boxes under the face grid, [K]."""
    mask = torch.zeros(GRID, GRID, dtype=torch.bool)
    mask[ROW : ROW + CELLS, COLUMN : COLUMN + CELLS] = True
    return mask.flatten()


def joined(first: Frames, second: Frames) -> Frames:
    names = [field.name for field in dataclasses.fields(Frames)]
    return Frames(*(torch.cat([getattr(first, name), getattr(second, name)]) for name in names))


def images_of(person: Person) -> list[tuple[Camera, torch.Tensor, float]]:
    """Cameras, images and weights that `payloads` fits to."""
    views = [(*view, rasterise(person.mesh, view[0], SUPERSAMPLE)) for view in views_of(person.mesh, person.betas)]
    return [
        (camera, torch.from_numpy(np.dstack([picture.rgb, picture.alpha])), weight) for camera, weight, picture in views
    ]


def march_ratio(few: Primitives, many: Primitives, camera: Camera) -> float:
    """Median over alternating calls of the processor's time for `many` over that for `few`."""
    return float(np.median([spent(many, camera) / spent(few, camera) for _ in range(CALLS)][1:]))


def spent(boxes: Primitives, camera: Camera) -> float:
    begun = time.process_time()
    march(boxes, camera)
    return time.process_time() - begun


def sizes(payload: Payload, betas: np.ndarray) -> Mapping[str, int]:
    """Bytes of a human by where they are."""
    rest = {"delta_scale": payload.delta_scale, "betas": torch.from_numpy(betas).float()}
    rgb, density, _ = to_eight_bits(payload.rgb.numpy(), payload.density.numpy())
    compact = {"rgb": torch.from_numpy(rgb), "density": torch.from_numpy(density), **rest}
    return {
        "payload": sum(tensor.nbytes for tensor in (payload.rgb, payload.density, payload.delta_scale)),
        "human_file": len(tensor_file.save({"rgb": payload.rgb, "density": payload.density, **rest}, {})),
        "compact_human_file": len(tensor_file.save(compact, {})),
        "engine_texture": payload.density.numel() * HALF_FLOAT_VOXEL,
    }


if __name__ == "__main__":
    main()
