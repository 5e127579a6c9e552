"""The people of benchmarks/chain.py, the views they are seen in and what each stage of the chain makes of them."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from primdiffusion.body.model import BodyPose, ShapedBody, default_body
from primdiffusion.capture.poses import built_in_poses
from primdiffusion.diffusion.codec import CellCodec, cells_from_voxels
from primdiffusion.diffusion.denoiser import PersonDenoiser
from primdiffusion.diffusion.model import DiffusionModel, sample, seeded_generator
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.formats.poses.motion import built_in_vectors
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.textured_mesh import TexturedMesh
from primdiffusion.human import Human, decode_humans
from primdiffusion.people.assets import Assets
from primdiffusion.people.base_mesh import load_base_mesh
from primdiffusion.people.payloads import (
    GUESS_LEVEL,
    HEAD_EXTENT,
    HEAD_FOV,
    VARIANT_STRIDE,
    fitted_payloads,
    head_centre,
    orbit_camera,
    rest_frames,
    voxels_from_payload,
)
from primdiffusion.people.person import Person, make_person, recolour
from primdiffusion.people.stored_people import PersonVariants, read_payloads
from primdiffusion.people.wardrobe import attribute_labels
from primdiffusion.primitives.anchors import attach, default_anchors
from primdiffusion.primitives.from_mesh import FULL_DENSITY, colour, surface_field
from primdiffusion.primitives.primitives import Frames, Payload, Primitives
from primdiffusion.primitives.skirts import box_sizes
from primdiffusion.raster.rasterise import rasterise
from primdiffusion.render.march import march
from torch import Tensor

FIRST_SEED = 10_000_000
"""Training sets count from 0."""
BODY_SIZE, BODY_FOV, BODY_MARGIN, BODY_PITCH = 512, math.radians(30), 1.1, 5
HEAD_SIZE, HEAD_YAW = 256, 15
YAWS = {"front": 20, "back": 200}
"""Degrees."""
SUPERSAMPLE = 4
"""Samples along a pixel's side in true pictures."""
NOISE_STEPS = (100, 300, 500, 700)
POSES = ("walking", "sitting", "arms up", "arms crossed", "squatting", "dancing", "kicking")
TOGETHER = 8
"""People that are sampled at once."""


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """A person's mesh and boxes in one pose, with cameras."""

    mesh: TexturedMesh
    frames: Frames
    cameras: Mapping[str, Camera]

    def true(self, view: str, supersample: int = SUPERSAMPLE) -> Tensor:
        """The mesh: linear colour premultiplied by alpha, [H, W, 4]."""
        picture = rasterise(self.mesh, self.cameras[view], supersample)
        return torch.from_numpy(np.concatenate([picture.rgb, picture.alpha[..., None]], axis=-1))

    def drawn(self, view: str, payload: Payload) -> Tensor:
        """The boxes with a payload, likewise."""
        return draw(self.frames, payload, self.cameras[view])


def draw(frames: Frames, payload: Payload, camera: Camera) -> Tensor:
    view = march(Primitives.place(frames, payload), camera)
    return torch.cat([view.rgb, view.alpha[..., None]], dim=-1)


def held_out(assets: Assets, number: int) -> Person:
    return make_person(assets, load_base_mesh(), FIRST_SEED + number)


def rest_scene(person: Person) -> Scene:
    """The T pose: body from the front and the back, head."""
    head = head_camera(head_centre(person.betas))
    return Scene(person.mesh, rest_frames(person.betas), body_cameras(person.mesh.bounds) | {"head": head})


def posed_scenes(person: Person) -> Iterator[Scene]:
    """Other poses: body from the front, and the head from its own front."""
    names, rotations = list(built_in_vectors()), built_in_poses().joint_rotation.float()
    body, head = default_body(), JOINT_NAMES.index("head")
    in_rest = shaped(person.betas)
    for name in POSES:
        posed = in_rest.pose(BodyPose(rotations[names.index(name)], torch.zeros(3)))
        mesh = person.mesh.posed(posed.skinning.numpy())
        turn, move = posed.skinning[head, :3, :3].numpy(), posed.skinning[head, :3, 3].numpy()
        yaw = math.degrees(math.atan2(turn[0, 2], turn[2, 2]))
        cameras = {
            "front": body_cameras(mesh.bounds)["front"],
            "head": head_camera(turn @ head_centre(person.betas) + move, yaw),
        }
        yield Scene(mesh, attach(default_anchors(), posed.vertices, body.faces), cameras)


def body_cameras(bounds: np.ndarray) -> dict[str, Camera]:
    low, high = bounds
    extent = BODY_MARGIN * float((high - low).max())
    return {
        view: orbit_camera((low + high) / 2, extent, yaw, BODY_PITCH, BODY_FOV, BODY_SIZE) for view, yaw in YAWS.items()
    }


def body_camera_of(betas: np.ndarray) -> Camera:
    """The front camera of a person without a mesh: around the bare body."""
    vertices = shaped(betas).vertices.numpy()
    return body_cameras(np.stack([vertices.min(0), vertices.max(0)]))["front"]


def shaped(betas: np.ndarray) -> ShapedBody:
    body = default_body()
    return body.shape(torch.from_numpy(betas).to(body.template.dtype))


def head_camera(centre: np.ndarray, yaw: float = 0.0) -> Camera:
    return orbit_camera(centre, HEAD_EXTENT, yaw + HEAD_YAW, 0, HEAD_FOV, HEAD_SIZE)


def start_of(person: Person, frames: Frames) -> Payload:
    """`from_mesh`, before its storage in bytes."""
    return colour(surface_field(person.mesh, frames), person.mesh)


def stored(payload: Payload, betas: np.ndarray) -> PersonVariants:
    """A payload as its file would hold it."""
    return PersonVariants(
        torch.from_numpy(voxels_from_payload(payload))[None],
        payload.delta_scale[None],
        torch.from_numpy(betas).float(),
        ({},),
        FULL_DENSITY,
    )


def learns_fitted(model: DiffusionModel) -> bool:
    """Whether its latents are of fitted payloads; those of older models are of `from_mesh`."""
    return model.full_density == FULL_DENSITY


def at_density(person: PersonVariants, full_density: float) -> Payload:
    """The stored payload, its densities relative to another full one."""
    return dataclasses.replace(person, full_density=full_density).payload(0)


def latents_of(model: DiffusionModel, person: PersonVariants) -> Tensor:
    """Clean samples [1, *shape] of a stored person, as training makes them.

    Training encodes stored voxels as they are; `model.encode` also undoes the dead zone of decoding.
    """
    if isinstance(model.codec, CellCodec):
        return model.codec.codec.encode(cells_from_voxels(person.voxels, person.delta_scale))
    return model.encode(at_density(person, model.full_density))[None]


def denoised_once(model: DiffusionModel, x0: Tensor, seed: int) -> Iterator[tuple[int, Tensor]]:
    """One denoising step from each of NOISE_STEPS, all with the same noise."""
    noise = torch.randn(x0.shape, generator=seeded_generator(seed))
    for t in NOISE_STEPS:
        yield t, model.denoise(model.schedule.q_sample(x0, torch.tensor([t]), noise), t)


def explained(model: DiffusionModel, x0: Tensor) -> Tensor:
    """What the model takes a clean sample for: its guess at GUESS_LEVEL without noise."""
    return model.denoise(model.schedule.signal(GUESS_LEVEL) * x0, GUESS_LEVEL)


def decoded(model: DiffusionModel, x0: Tensor) -> Payload:
    """The payload of one clean sample [1, *shape], fit for the marcher."""
    return model.decode(x0[0]).to("cpu").map(lambda tensor: tensor.clone())


def generated(model: DiffusionModel, count: int) -> Iterator[tuple[Tensor, Human]]:
    """Clean samples [1, *shape] of seeds 0, 1, ... by the default sampler and steps, and their people."""
    for first in range(0, count, TOGETHER):
        seeds = list(range(first, min(first + TOGETHER, count)))
        *_, last = sample(model, seeds)
        yield from zip(last.x0.split(1), decode_humans(model, last.x0, seeds), strict=True)


def rest_of(model: DiffusionModel, samples: Sequence[Tensor]) -> Tensor | None:
    """What person components leave out of clean samples; None for a model without such components."""
    if not isinstance(model.denoiser, PersonDenoiser):
        return None
    return model.denoiser.prior.split(torch.cat(list(samples)))[1]


def fit(
    people: Sequence[Person], frames: Frames, model: DiffusionModel, turn: float = 0.0
) -> tuple[list[Payload], float]:
    """Fitted payloads of colourings of one geometry, and the processor's seconds."""
    begun = time.process_time()
    sizes = box_sizes(attribute_labels(people[0].attributes)["outfit"])
    payloads = fitted_payloads([person.mesh for person in people], frames, people[0].betas, model, sizes, turn=turn)
    return payloads, time.process_time() - begun


def recoloured(person: Person, number: int, count: int) -> list[Person]:
    """The held-out person with this number, and `count` other colourings."""
    seed = FIRST_SEED + number
    return [person, *(recolour(person, seed + variant * VARIANT_STRIDE) for variant in range(1, count + 1))]


def stored_fit(folder: Path, number: int) -> PersonVariants:
    """A held-out person's fitted payload from its file."""
    return read_payloads(folder / f"person_{FIRST_SEED + number:06d}.npz")
