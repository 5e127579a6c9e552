"""The whole pipeline on one page: generate a human, pose it, frame it for `render.march.march`.

    model = load_checkpoint()                          # diffusion: noise -> payload and betas
    human = generate(model, seed=7)
    primitives = place(human, BodyPose.from_axis_angle(theta))   # body: betas, theta -> mesh -> frames; payload in them
    rendering = march(primitives, framing(primitives, yaw_degrees=30))

Frames are computed on the posed mesh for every pose, as in the paper (sec. 3.1): the mesh drives the primitives.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.body.model import BodyModel, BodyPose, PosedBody, betas_of_measures, default_body
from primdiffusion.diffusion.conditioning import Attributes
from primdiffusion.diffusion.model import DiffusionModel, sample, unfollowed
from primdiffusion.diffusion.samplers import SamplerStep
from primdiffusion.diffusion.schedule import CLEAN
from primdiffusion.formats import requests
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.geometry.camera import Camera, look_at
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.geometry.rotation import polar
from primdiffusion.primitives.anchors import Anchors, attach, default_anchors, stretch
from primdiffusion.primitives.body_setup import BodySetup
from primdiffusion.primitives.primitives import Frames, Payload, Primitives
from primdiffusion.runtime.device import on_fixed_threads
from primdiffusion.version import __version__

VERTICAL_FOV = math.radians(30)
LARGEST_PICTURE = 8192
"""Pixels per side; a limit that keeps a mistyped size from exhausting memory."""
SMALLEST_SCALE = 1e-6
"""Smallest accepted scale of an object; below it, float32 cannot resolve the human."""
FRAMING_MARGIN = 1.04
"""Camera distance relative to the distance at which the human just fills the image."""


@dataclasses.dataclass(frozen=True)
class Human(TensorRecord):
    """One human, independent of pose: the payload of the primitives and the shape of the body they are attached to.

    >>> human.validate().betas.shape
    torch.Size([10])
    """

    payload: Payload
    """Unbatched."""
    betas: Float[Tensor, "n"]
    """Shape coefficients of the body."""
    provenance: Mapping[str, Any]
    """Origin of the human; JSON values. For a generated one: seed, steps, sampler, `end` if it is not the clean
    sample, attributes and guidance if requested, `unfollowed` (the values that it shows instead of requested ones,
    `diffusion.model`), checkpoint, checkpoint_sha256, full_density, version."""
    body_setup: BodySetup | None = None
    """Body and anchors; None is the default body."""

    def validate(self) -> Human:
        """Return self if this is one complete human with finite values; otherwise raise ValueError."""
        self.payload.validate()
        if self.payload.density.ndim != 4:
            raise ValueError(
                f"expected one human, got a batch of shape {tuple(self.payload.density.shape[:-4])}: select one sample"
            )
        if self.betas.ndim != 1 or not torch.isfinite(self.betas).all():
            given = f"{self.betas.tolist()!s:.80}"
            raise ValueError(f"betas must be one row of finite numbers, not {given}: generate the human again")
        return self


def generate(
    model: DiffusionModel,
    seed: int,
    steps: int = requests.Sampling.steps,
    sampler: str = requests.GenerateRequest.sampler,
    on_step: Callable[[SamplerStep], None] | None = None,
    attributes: Attributes = MappingProxyType({}),
    guidance: float = requests.Conditioning.guidance,
    end: int = CLEAN,
) -> Human:
    """A new human, on the CPU, determined by model, seed, steps, sampler, attributes and guidance.

    On one kind of processor, with one version of torch, every bit is the same on any number of cores and threads
    (`device.fixed_threads`); otherwise, and in a batch, values differ by rounding (about 1e-5 of their range).

    `attributes` condition the sample on attributes in `model.vocabulary`; those left open are drawn from the seed.
    `on_step` is called after each step; raise an exception from it to cancel.
    `end` is the level at which the sampler ddim ends: `samplers.RELEASED_END` as in the released code.

        >>> human = pd.generate(model, seed=57)
        >>> human.payload.density.shape  # boxes, and the voxels along their sides
        torch.Size([1024, 8, 8, 8])

    Raises ValueError for an unknown sampler or attribute, a number of steps outside 1 ... T, or a seed outside
    0 ... 2^63-1.
    """
    return generate_batch(model, [seed], steps, sampler, on_step, attributes, guidance, end)[0]


def generate_batch(
    model: DiffusionModel,
    seeds: Sequence[int],
    steps: int = requests.Sampling.steps,
    sampler: str = requests.GenerateRequest.sampler,
    on_step: Callable[[SamplerStep], None] | None = None,
    attributes: Attributes = MappingProxyType({}),
    guidance: float = requests.Conditioning.guidance,
    end: int = CLEAN,
) -> list[Human]:
    """One human per seed, sampled as a batch; equal to `generate` up to rounding. Raises the same errors."""
    condition = model.condition(attributes)
    if not math.isfinite(guidance):
        raise ValueError(f"guidance is {guidance}: give a finite number, 1 for none")
    final = None
    for step in sample(model, seeds, steps, sampler, condition, guidance, end):
        if on_step is not None:
            on_step(step)
        final = step.x
    assert final is not None, "a sampler yields at least one step"
    numbers = {name: float(attributes[name]) for name in model.vocabulary.scalars if name in attributes}
    conditioning: dict[str, Any] = {"attributes": {**attributes, **numbers}} if attributes else {}
    if model.vocabulary.width:
        conditioning["guidance"] = guidance
    ending = {} if end == CLEAN else {"end": end}
    shared = {"steps": steps, "sampler": sampler, **ending, **conditioning, **model_provenance(model)}
    people = decode_humans(model, final, seeds, attributes)
    missed = ({"unfollowed": names} if names else {} for names in unfollowed(model, final, attributes))
    return [
        dataclasses.replace(human, provenance={"seed": seed, **shared, **names}).validate()
        for human, seed, names in zip(people, seeds, missed, strict=True)
    ]


@on_fixed_threads
def decode_humans(
    model: DiffusionModel,
    x0: Float[Tensor, "b c h w"],
    seeds: Sequence[int],
    attributes: Attributes = MappingProxyType({}),
) -> list[Human]:
    """Decode denoised samples x0 into humans on the CPU, in colours of people, without provenance or validation."""
    body = default_body() if model.body_setup is None else model.body_setup.body
    wanted = measures_of(attributes)
    people = []
    x0 = model.with_peoples_colours(x0)
    for sample_of_one, betas in zip(x0, model.betas(x0, seeds), strict=True):
        if wanted != (None, None):
            betas = betas_of_measures(betas.cpu(), model.shapes.scale.cpu(), body, *wanted)
        people.append(Human(model.decode(sample_of_one), betas, {}, model.body_setup).to("cpu"))
    return people


def model_provenance(model: DiffusionModel) -> dict[str, Any]:
    """The provenance entries that describe the model and the program version."""
    of_file = {"checkpoint_sha256": model.card["sha256"]} if "sha256" in model.card else {}
    return {
        "checkpoint": model.card.get("name", "unnamed"),
        **of_file,
        "full_density": model.full_density,
        "version": __version__,
    }


def measures_of(attributes: Attributes) -> tuple[float | None, float | None]:
    """The requested height (m) and weight (kg), each None if not requested."""
    height, weight = (
        attributes.get(name) for name in ("height", "weight")
    )  # already parsed to numbers by the vocabulary
    return None if height is None else float(height), None if weight is None else float(weight)


def pose_body(betas: Float[Tensor, "n"], pose: BodyPose | None = None, body: BodyModel | None = None) -> PosedBody:
    """The body with this shape in this pose; None is the T pose and the default body."""
    body = default_body() if body is None else body
    return body.shape(betas).pose(BodyPose.rest() if pose is None else pose)


def place(
    human: Human, pose: BodyPose | None = None, body: BodyModel | None = None, anchors: Anchors | None = None
) -> Primitives:
    """The human's primitives in the world; None is the T pose, and the human's own body and anchors.

    Anchors belong to a body: give both or neither. Differentiable in the pose and the human.

        >>> boxes = pd.place(human, pose)
        >>> boxes.position.shape
        torch.Size([1024, 3])
    """
    return Primitives.place(frames_of(human, pose, body, anchors), human.payload)


def sole_height(human: Human) -> float:
    """Height of the soles of the human's body at rest, metres: y = 0 in files for other programs, as in Blender."""
    return float(body_of(human)[0].shape(human.betas).vertices[:, 1].min())


def place_on_floor(human: Human, pose: BodyPose | None = None) -> Primitives:
    """Same as `place`, in a world whose y is 0 at `sole_height`."""
    placed = place(human, pose)
    return dataclasses.replace(placed, position=placed.position - torch.tensor([0.0, sole_height(human), 0.0]))


def frames_of(
    human: Human, pose: BodyPose | None = None, body: BodyModel | None = None, anchors: Anchors | None = None
) -> Frames:
    """Frames where `place` puts the human's primitives, with their extents before the delta scales."""
    body, anchors = body_of(human, body, anchors)
    return _frames(human, pose_body(human.betas, pose, body).vertices, body, anchors)


def default_frames(betas: Float[Tensor, "n"], pose: BodyPose) -> Frames:
    """Same as `frames_of`, for a human of this shape on the default body; differentiable in both."""
    body, anchors = default_body(), default_anchors()
    vertices = pose_body(betas, pose).vertices
    return stretch(attach(anchors, vertices, body.faces), anchors, vertices, body.shape(betas).vertices)


def place_skinned(
    human: Human,
    skinning: Float[Tensor, "24 r 4"],
    object_to_world: Float[Tensor, "r 4"],
    body: BodyModel | None = None,
    anchors: Anchors | None = None,
) -> Primitives:
    """The human's primitives posed by an armature: affine matrices (r = 3 or 4 rows) of the joints and the object.

    `skinning` maps rest to posed points in object space (posed x rest^-1, SMPL's joint order). The object's 3x3 part is
    split into Q P (`polar`): the stretch P deforms the posed vertices that carry the frames, and with s = cbrt(det P)
    boxes are scaled by s and densities by 1/s, so that opacity does not depend on size; Q and the translation move the
    frames. If the object mirrors, so do the frames (det -1).

    Raises ValueError for matrices with NaN or infinite values, and for an object or joint scaled to zero.
    """
    body, anchors = body_of(human, body, anchors)
    for name, matrix in (("skinning", skinning), ("object_to_world", object_to_world)):
        if not torch.isfinite(matrix).all():
            raise ValueError(f"{name} holds NaN or infinite values: check the pose and scale of the armature")
    flat = torch.linalg.det(skinning[:, :3, :3].double()).abs() < SMALLEST_SCALE**3
    if flat.any():
        name = JOINT_NAMES[int(flat.int().argmax())]
        raise ValueError(f"the bone of joint {name!r} is scaled to zero: give it a nonzero scale")
    orthogonal, stretch = polar(object_to_world[:3, :3].double())
    scale = float(torch.linalg.det(stretch)) ** (1 / 3)
    if not scale > SMALLEST_SCALE:
        raise ValueError(f"the object's mean scale is {scale:.3g}: give it a nonzero scale along every axis")
    orthogonal, unit_stretch = orthogonal.to(skinning), (stretch / scale).to(skinning)
    vertices = body.shape(human.betas).follow(skinning) @ unit_stretch.T
    frames = _frames(human, vertices, body, anchors)
    frames = Frames(
        position=frames.position @ (scale * orthogonal).T + object_to_world[:3, 3],
        rotation=orthogonal @ frames.rotation,
        half_extent=frames.half_extent * scale,
    )
    unscaled = abs(scale - 1) < 1e-6  # up to float32 rounding of a rotation; avoids copying the payload
    payload = human.payload
    return Primitives.place(
        frames, payload if unscaled else dataclasses.replace(payload, density=payload.density / scale)
    )


def _frames(human: Human, vertices: Float[Tensor, "v 3"], body: BodyModel, anchors: Anchors) -> Frames:
    """Frames on posed vertices; boxes follow the stretch of the skin, except those of the released code."""
    frames = attach(anchors, vertices, body.faces)
    if human.body_setup is not None:
        return frames
    return stretch(frames, anchors, vertices, body.shape(human.betas).vertices)


def body_of(human: Human, body: BodyModel | None = None, anchors: Anchors | None = None) -> tuple[BodyModel, Anchors]:
    """The given body and anchors, or else the human's own; ValueError if only one of the two is given."""
    if body is None and anchors is None:
        if human.body_setup is None:
            return default_body(), default_anchors()
        return human.body_setup.body, human.body_setup.anchors
    if body is None or anchors is None:
        raise ValueError("body and anchors must be given together: give both, or neither to use the human's own")
    return body, anchors


def framing(primitives: Primitives, yaw_degrees: float = 0.0, width: int = 512, height: int = 512) -> Camera:
    """A level camera that frames all of `primitives`, at the height of their centre.

    `yaw_degrees`: 0 shows the front of the human, 90 the left side. The vertical field of view is 30 degrees.

        >>> camera = pd.framing(boxes, yaw_degrees=30, width=48, height=64)
        >>> camera.width, camera.height
        (48, 64)

    Raises ValueError for an image side outside 1 ... LARGEST_PICTURE pixels.
    """
    if not 1 <= min(width, height) <= max(width, height) <= LARGEST_PICTURE:
        raise ValueError(f"the image size is {width} x {height} pixels: choose sides from 1 to {LARGEST_PICTURE}")
    signs = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3).to(primitives.position)
    local = primitives.half_extent[:, None] * signs
    corners = primitives.position[:, None] + (primitives.rotation[:, None] @ local[..., None])[..., 0]
    corners = corners.detach().flatten(0, 1)
    middle = (corners.amin(0) + corners.amax(0)) / 2
    yaw = math.radians(yaw_degrees)
    towards_camera = middle.new_tensor([math.sin(yaw), 0.0, math.cos(yaw)])
    right = middle.new_tensor([math.cos(yaw), 0.0, -math.sin(yaw)])
    offset = corners - middle
    slope = math.tan(VERTICAL_FOV / 2)
    needed = torch.maximum(offset[:, 1].abs() / slope, (offset @ right).abs() / (slope * width / height))
    distance = FRAMING_MARGIN * float((needed + offset @ towards_camera).amax())
    return look_at(middle + distance * towards_camera, middle, vertical_fov=VERTICAL_FOV, width=width, height=height)
