"""A person on one page: generate, pose, look.

    model = load_checkpoint()                          # diffusion: noise -> payload and betas
    human = generate(model, seed=7)
    primitives = place(human, BodyPose.from_axis_angle(theta))   # body: betas, theta -> mesh -> frames; payload in them
    rendering = march(primitives, framing(primitives, yaw=0.5))

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

from primdiffusion import __version__
from primdiffusion.body.measures import betas_of_measures
from primdiffusion.body.model import BodyModel, BodyPose, PosedBody, default_body
from primdiffusion.diffusion.conditioning import Attributes
from primdiffusion.diffusion.model import DiffusionModel, sample
from primdiffusion.diffusion.samplers import Step
from primdiffusion.formats import requests
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.geometry.camera import Camera, look_at
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.geometry.rotation import polar
from primdiffusion.primitives.anchors import Anchors, attach, default_anchors
from primdiffusion.primitives.body_setup import BodySetup
from primdiffusion.primitives.primitives import Frames, Payload, Primitives
from primdiffusion.render.march import MarchSettings, Rendering, march

DEFAULT_SETTINGS = MarchSettings()
VERTICAL_FOV = math.radians(30)
LARGEST_PICTURE = 8192
"""Pixels a side; beyond, a slip of the finger takes all memory."""
SMALLEST_SCALE = 1e-6
"""Of an object: below, a person is smaller than what float32 tells apart."""
FRAMING_MARGIN = 1.04
"""How much farther than just filling the picture the camera stands."""


@dataclasses.dataclass(frozen=True)
class Human(TensorRecord):
    """One person, independent of pose: what fills the primitives, and the body they sit on."""

    payload: Payload
    """Unbatched."""
    betas: Float[Tensor, "n"]
    """Shape coefficients of the body they stand on."""
    provenance: Mapping[str, Any]
    """Where the person comes from; JSON values. Of a generated one: seed, steps, sampler, attributes if any were asked
    for, checkpoint, checkpoint_sha256, full_density, version."""
    body_setup: BodySetup | None = None
    """Body and anchors that they stand on; None is the default body."""

    def validate(self) -> Human:
        """Itself, if it is one whole person with finite values; otherwise ValueError that names what is wrong."""
        self.payload.validate()
        if self.payload.density.ndim != 4:
            raise ValueError(
                f"a human holds one person, not a batch {tuple(self.payload.density.shape[:-4])}: pick one"
            )
        if self.betas.ndim != 1 or not torch.isfinite(self.betas).all():
            raise ValueError(f"betas must be one row of finite numbers, not {self.betas!r}: generate the person again")
        return self


def generate(
    model: DiffusionModel,
    seed: int,
    steps: int = requests.STEPS,
    sampler: str = requests.SAMPLERS[0],
    on_step: Callable[[Step], None] | None = None,
    attributes: Attributes = MappingProxyType({}),
    guidance: float = requests.GUIDANCE,
) -> Human:
    """A new person, on the CPU; the same for the same model, seed, steps, sampler, attributes, guidance and device.

    `attributes` are what the person is asked to be, of what `model.vocabulary` knows; by default anybody (the paper).
    `on_step` sees each step after it is done; an exception it raises ends the work (that is how cancelling works).
    Raises ValueError for an unknown sampler or attribute, a number of steps outside 1 ... T, or a seed outside
    0 ... 2^63-1.
    """
    return generate_batch(model, [seed], steps, sampler, on_step, attributes, guidance)[0]


def generate_batch(
    model: DiffusionModel,
    seeds: Sequence[int],
    steps: int = requests.STEPS,
    sampler: str = requests.SAMPLERS[0],
    on_step: Callable[[Step], None] | None = None,
    attributes: Attributes = MappingProxyType({}),
    guidance: float = requests.GUIDANCE,
) -> list[Human]:
    """People of several seeds, who share the work; each as `generate` makes them, but for rounding. Errors likewise."""
    condition = model.condition(attributes)
    if not math.isfinite(guidance):
        raise ValueError(f"guidance is {guidance}: give a number, 1 for none")
    final = None
    for step in sample(model, seeds, steps, sampler, condition, guidance):
        if on_step is not None:
            on_step(step)
        final = step.x0
    assert final is not None, "a sampler yields at least one step"
    numbers = {name: float(attributes[name]) for name in model.vocabulary.scalars if name in attributes}
    asked = {"attributes": {**attributes, **numbers}, "guidance": guidance} if attributes else {}
    made = {"steps": steps, "sampler": sampler, **asked, **made_by(model)}
    people = people_of(model, final, seeds, attributes)
    return [
        dataclasses.replace(human, provenance={"seed": seed, **made}).validate()
        for human, seed in zip(people, seeds, strict=True)
    ]


def people_of(
    model: DiffusionModel,
    x0: Float[Tensor, "b c h w"],
    seeds: Sequence[int],
    attributes: Attributes = MappingProxyType({}),
) -> list[Human]:
    """The people whom clean samples of these seeds stand for, on the CPU; without provenance, and unchecked."""
    body = default_body() if model.body_setup is None else model.body_setup.body
    people = []
    for sample_of_one, betas in zip(x0, model.betas(x0, seeds), strict=True):
        betas = betas_of_measures(betas.cpu(), model.shapes.scale.cpu(), body, *measures_of(attributes))
        people.append(Human(model.decode(sample_of_one), betas, {}, model.body_setup).to("cpu"))
    return people


def made_by(model: DiffusionModel) -> dict[str, Any]:
    """What a person's provenance says of the model and program that made them."""
    of_file = {"checkpoint_sha256": model.card["sha256"]} if "sha256" in model.card else {}
    return {
        "checkpoint": model.card.get("name", "unnamed"),
        **of_file,
        "full_density": model.full_density,
        "version": __version__,
    }


def measures_of(attributes: Attributes) -> tuple[float | None, float | None]:
    """Height (m) and weight (kg) that are asked for; None where they are not."""
    height, weight = (attributes.get(name) for name in ("height", "weight"))  # numbers: the vocabulary has read them
    return None if height is None else float(height), None if weight is None else float(weight)


def pose_body(betas: Float[Tensor, "n"], pose: BodyPose | None = None, body: BodyModel | None = None) -> PosedBody:
    """The body with this shape in this pose; None stands for the T pose and the default body."""
    body = default_body() if body is None else body
    return body.shape(betas).pose(BodyPose.rest() if pose is None else pose)


def place(
    human: Human, pose: BodyPose | None = None, body: BodyModel | None = None, anchors: Anchors | None = None
) -> Primitives:
    """The person's primitives in the world; None stands for the T pose, the body they stand on and its anchors.

    Anchors belong to a body: give both or neither. Differentiable in the pose and the human.
    """
    body, anchors = body_of(human, body, anchors)
    frames = attach(anchors, pose_body(human.betas, pose, body).vertices, body.faces)
    return Primitives.place(frames, human.payload)


def place_skinned(
    human: Human,
    skinning: Float[Tensor, "24 r 4"],
    object_to_world: Float[Tensor, "r 4"],
    body: BodyModel | None = None,
    anchors: Anchors | None = None,
) -> Primitives:
    """The person's primitives as an armature moves them: affine matrices (r = 3 or 4 rows), joints' and the object's.

    `skinning` takes rest to posed in the object's space (posed x rest^-1, SMPL's joint order). The object's 3x3 part
    is split into Q P (`polar`): the stretch P moves the posed vertices, on which the frames sit, and with
    s = cbrt(det P) boxes are s times as large and 1/s as dense, so a person is as opaque at any size; Q and the
    translation move the frames. Where the object mirrors, so do the frames (det -1).

    Raises ValueError for matrices with NaN or infinite values, and for a flat object or joint (scaled to zero).
    """
    body, anchors = body_of(human, body, anchors)
    for name, matrix in (("skinning", skinning), ("object_to_world", object_to_world)):
        if not torch.isfinite(matrix).all():
            raise ValueError(f"{name} holds NaN or infinite values: check the pose and scale of the armature")
    flat = torch.linalg.det(skinning[:, :3, :3].double()).abs() < SMALLEST_SCALE**3
    if flat.any():
        name = JOINT_NAMES[int(flat.int().argmax())]
        raise ValueError(f"skinning flattens the joint {name!r}: give its bone a scale other than zero")
    orthogonal, stretch = polar(object_to_world[:3, :3].double())
    scale = float(torch.linalg.det(stretch)) ** (1 / 3)
    if not scale > SMALLEST_SCALE:
        raise ValueError(f"the object is scaled to {scale:.3g} of its size: give it a scale other than zero")
    orthogonal, unit_stretch = orthogonal.to(skinning), (stretch / scale).to(skinning)
    vertices = body.shape(human.betas).follow(skinning) @ unit_stretch.T
    frames = attach(anchors, vertices, body.faces)
    frames = Frames(
        position=frames.position @ (scale * orthogonal).T + object_to_world[:3, 3],
        rotation=orthogonal @ frames.rotation,
        half_extent=frames.half_extent * scale,
    )
    unscaled = abs(scale - 1) < 1e-6  # as after a rotation in float32; the payload then stays the same tensor
    payload = human.payload
    return Primitives.place(
        frames, payload if unscaled else dataclasses.replace(payload, density=payload.density / scale)
    )


def body_of(human: Human, body: BodyModel | None = None, anchors: Anchors | None = None) -> tuple[BodyModel, Anchors]:
    """The body and anchors that are given, or those that the person stands on; ValueError for one without the other."""
    if body is None and anchors is None:
        if human.body_setup is None:
            return default_body(), default_anchors()
        return human.body_setup.body, human.body_setup.anchors
    if body is None or anchors is None:
        raise ValueError("a body and its anchors go together: give both, or neither for the person's own")
    return body, anchors


def framing(primitives: Primitives, yaw: float = 0.0, width: int = 512, height: int = 512) -> Camera:
    """A level camera that just sees all of `primitives`; it stands at the height of their middle.

    `yaw` in radians: 0 looks at the person's face, pi/2 at their left side. 30 degrees of view from top to bottom.
    Raises ValueError for sides outside 1 ... LARGEST_PICTURE pixels.
    """
    if not 1 <= min(width, height) <= max(width, height) <= LARGEST_PICTURE:
        raise ValueError(
            f"a picture of {width} x {height} pixels was asked for: choose sides of 1 to {LARGEST_PICTURE}"
        )
    signs = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3).to(primitives.position)
    local = primitives.half_extent[:, None] * signs
    corners = primitives.position[:, None] + (primitives.rotation[:, None] @ local[..., None])[..., 0]
    corners = corners.detach().flatten(0, 1)
    middle = (corners.amin(0) + corners.amax(0)) / 2
    towards_camera = middle.new_tensor([math.sin(yaw), 0.0, math.cos(yaw)])
    right = middle.new_tensor([math.cos(yaw), 0.0, -math.sin(yaw)])
    offset = corners - middle
    slope = math.tan(VERTICAL_FOV / 2)
    needed = torch.maximum(offset[:, 1].abs() / slope, (offset @ right).abs() / (slope * width / height))
    distance = FRAMING_MARGIN * float((needed + offset @ towards_camera).amax())
    return look_at(middle + distance * towards_camera, middle, vertical_fov=VERTICAL_FOV, width=width, height=height)


def render(
    human: Human, camera: Camera, pose: BodyPose | None = None, settings: MarchSettings = DEFAULT_SETTINGS
) -> Rendering:
    """The person in a pose (None: T pose) as the camera sees them."""
    return march(place(human, pose), camera, settings)
