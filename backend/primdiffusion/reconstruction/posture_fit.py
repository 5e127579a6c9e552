"""Refine pose, shape and cameras of a human in pictures, by gradients of the marcher.

The human's primitives are drawn on a posture (body -> frames -> `march`), and colours and opacity compared with the
pictures. Parameters are measured in standard deviations from where they start, so that the penalty |u|^2 / 2 is a
prior: what a picture does not show, such as how far an arm points at the camera, stays as it was. Differences are
compared after a blur that shrinks from stage to stage, because a limb beside the true one has no gradient in sharp
pictures.

A picture alone cannot tell a leaning body before a level camera from an upright one before a tilted camera, so the
prior says what is likely of a photograph: the person stands on a floor, the camera is held by hand (`deviations`).
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from primdiffusion.body.model import BodyPose, ShapedBody, default_body, skin, world_from_joints, world_from_rest
from primdiffusion.diffusion.model import ShapePrior
from primdiffusion.formats.joints import JOINT_NAMES, PARENTS
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.geometry.rotation import axis_angle_to_matrix
from primdiffusion.human import default_frames
from primdiffusion.primitives.primitives import Frames, Payload, Primitives
from primdiffusion.render.descent import Adam
from primdiffusion.render.image import PosedView
from primdiffusion.render.inverse import BACKGROUND
from primdiffusion.render.march import MarchSettings, march

TILT_STD = torch.tensor([math.radians(12), 0.0, math.radians(2.5)])
"""Standard deviations of a held camera's pitch, yaw and roll; the body's own yaw stands for that of the camera."""
HEIGHT_M, HEIGHT_STD_M = 1.5, 0.3
"""Height of a held camera above the floor."""
LEAN_STD, SIDE_LEAN_STD = math.sin(math.radians(2)), math.sin(math.radians(1.5))
"""Standard deviations of a standing torso from the vertical, forward and to the side, where people sway less."""
STRIDE_M, STRIDE_LEAN = 0.2, math.sin(math.radians(5))
"""Distance of one ankle before the other at which a torso leans forward or back 1.4 times as much, and the lean of a
long stride."""
BALANCE_STD_M = 0.03
"""Standard deviation of the centre of mass from above the line between the feet."""
SOLE_STD_M = 0.015
"""Standard deviation of the height of one sole above the other."""
FLAT_STD, LIFTED = math.sin(math.radians(4)), 3.0
"""Standard deviation of a sole from the level, and the number of them from which a foot is taken to be lifted."""
_SEGMENTS = (
    ("pelvis", "neck", 0.497, 0.5), ("neck", "head", 0.081, 1.0),
    *((f"{side}_{near}", f"{side}_{far}", mass, share) for side in ("left", "right") for near, far, mass, share in (
        ("shoulder", "elbow", 0.028, 0.436), ("elbow", "wrist", 0.022, 0.682),
        ("hip", "knee", 0.1, 0.433), ("knee", "ankle", 0.061, 0.606))),
)  # fmt: skip
"""Parts of a body: joints at its ends, share of the mass, and where its centre is between them (Winter, Biomechanics
and Motor Control of Human Movement, table 4.1)."""


def deviations(body: ShapedBody, pose: BodyPose, camera_height: Float[Tensor, "v"]) -> Float[Tensor, "6 v"]:
    """Measure how unusual poses [v], and cameras at `camera_height` in their worlds (y up), are, in standard
    deviations: the torso from the vertical, the centre of mass from above the feet, one sole above the other, the left
    and the right sole from the level, and the camera above the floor.
    """
    world_from_joint = world_from_joints(pose.joint_rotation, body.joints, PARENTS)
    places = world_from_joint[..., :3, 3] + pose.translation[:, None]
    skinning, soles = world_from_rest(world_from_joint, body.joints), []
    for foot in _feet():
        points = skin(body.vertices[foot], body.model.skin_weights[foot], skinning)
        soles.append(points[..., 1].amin(1) + pose.translation[:, 1])
    left, right = soles
    torso = torch.nn.functional.normalize(_joint(places, "neck") - _joint(places, "pelvis"), dim=-1)
    (x, z), (left_x, left_z) = torso[:, [0, 2]].T, torch.nn.functional.normalize(world_from_joint[:, 0, [0, 2], 0]).T
    ankles = _joint(places, "left_ankle") - _joint(places, "right_ankle")
    stride = (1 + ((left_x * ankles[:, 2] - left_z * ankles[:, 0]) / STRIDE_M).square()).sqrt()
    forward = (left_x * z - left_z * x - STRIDE_LEAN * (1 - 1 / stride)) / (LEAN_STD * stride)
    lean = torch.stack([forward, (left_x * x + left_z * z) / SIDE_LEAN_STD])
    toes = world_from_joint[:, [JOINT_NAMES.index(f"{side}_ankle") for side in ("left", "right")], 1, 2].T / FLAT_STD
    return torch.stack([
        lean.norm(dim=0),
        _beside_feet(places) / BALANCE_STD_M,
        (left - right) / SOLE_STD_M,
        *toes / (1 + (toes / LIFTED).square()).sqrt(),
        (camera_height - torch.minimum(left, right) - HEIGHT_M) / HEIGHT_STD_M,
    ])  # fmt: skip


def _beside_feet(places: Float[Tensor, "v 24 3"]) -> Float[Tensor, "v"]:
    """Horizontal distance of the centre of mass from the line between the feet, metres."""
    centre = torch.stack(
        [mass * torch.lerp(_joint(places, near), _joint(places, far), share) for near, far, mass, share in _SEGMENTS]
    ).sum(0)
    left, right = ((_joint(places, f"{side}_ankle") + _joint(places, f"{side}_foot")) / 2 for side in ("left", "right"))
    across, to_centre = (right - left)[:, [0, 2]], (centre - left)[:, [0, 2]]
    along = (to_centre * across).sum(-1) / across.square().sum(-1).clamp_min(1e-6)
    return (to_centre - along.clamp(0, 1)[:, None] * across).square().sum(-1).add(1e-8).sqrt()


def _joint(places: Float[Tensor, "v 24 3"], name: str) -> Float[Tensor, "v 3"]:
    return places[:, JOINT_NAMES.index(name)]


@functools.cache
def _feet() -> list[Int[Tensor, "n"]]:
    """Vertices of the left and right foot of the default body."""
    nearest = default_body().skin_weights.argmax(1)
    feet = [[JOINT_NAMES.index(f"{side}_{name}") for name in ("ankle", "foot")] for side in ("left", "right")]
    return [torch.isin(nearest, torch.tensor(joints)).nonzero()[:, 0] for joints in feet]


Record = TypeVar("Record", bound=TensorRecord)

_DEGREES = {
    "pelvis": 12, "hip": 15, "knee": 15, "ankle": 10, "foot": 3, "spine1": 5, "spine2": 5, "spine3": 5, "neck": 8,
    "head": 10, "collar": 5, "shoulder": 20, "elbow": 20, "wrist": 10, "hand": 3,
}  # fmt: skip
JOINT_STD = torch.tensor(
    [math.radians(_DEGREES[name.removeprefix("left_").removeprefix("right_")]) for name in JOINT_NAMES]
)
"""Standard deviation of each joint's rotation from the start, radians; the pelvis turns the whole body."""
SIDEWAYS_STD_M, DEPTH_STD = 0.05, 0.1
"""Standard deviations of the position across the line of sight, and of the logarithm of the distance."""
FOCAL_STD, STATED_FOCAL_STD = 0.35, 0.03
"""Standard deviations of the logarithm of the focal length, of a guessed and of a stated lens."""
NEEDED = 3.0
"""Standard deviations from balance from which a known pose is taken to need it: a jump, a seat, a bow. Weights fall as
those of Geman and McClure."""
DATA_WEIGHT = 1500.0
"""Number of independent pixels over twice their variance: weight of the mean squared difference against the prior."""
RATE, LAST_RATE = 0.15, 0.2
"""Step of Adam, standard deviations, and the share of it that is left at the end."""
ADAM_BETAS = (0.8, 0.95)
"""Adam's decay rates."""
COARSE = MarchSettings(step=0.008)


@dataclasses.dataclass(frozen=True)
class Posture(TensorRecord):
    """Poses of one human in v pictures, and the cameras that see it."""

    pose: BodyPose
    """[v]."""
    betas: Float[Tensor, "10"]
    """Shape of the default body."""
    camera: Camera
    """[v]."""

    @property
    def facing(self) -> Float[Tensor, "v"]:
        """Cosine of the angle at which the body faces the camera: 1 from the front, -1 from behind."""
        return -(self.camera.world_to_camera[:, 2, :3] * self.pose.joint_rotation[:, 0, :, 2]).sum(-1)

    def frames(self) -> list[Frames]:
        """The boxes in each picture."""
        return [default_frames(self.betas, pose) for pose in each(self.pose)]


@dataclasses.dataclass(frozen=True)
class Stage:
    """A part of the fit."""

    steps: int
    blur: float
    """Standard deviation of the blur at the start, as a share of the picture's side; it halves to the end."""
    upright: bool = True
    """Whether lens and tilt are sought, and how people stand and hold cameras counts; not while limbs are far off."""


def each(records: Record) -> Iterator[Record]:
    """The members of a batch [v] of poses or cameras."""
    first = next(value for value in vars(records).values() if isinstance(value, Tensor))
    for number in range(len(first)):
        yield records.map(lambda values, number=number: values[number])


class PostureFit:
    """A posture on its way from where it started."""

    def __init__(
        self,
        start: Posture,
        shapes: ShapePrior,
        prior_precision: float = 1.0,
        *,
        tilted: bool = True,
        stated: Sequence[bool] = (),
    ) -> None:
        """`prior_precision` divides the variances of joints: above 1 where the pose is known well, so may be off
        balance.

        `tilted`: pitch, roll and height of the cameras are unknown; otherwise those of the start are true. `stated`:
        whether the lens of each camera is known; none is by default.
        """
        self._start, self._shapes, self._tilted = start, shapes, tilted
        self._joint_std = JOINT_STD[:, None] / math.sqrt(prior_precision)
        count = len(start.pose.translation)
        self._turn = torch.zeros(count, len(JOINT_NAMES), 3)
        self._move = torch.zeros(count, 3)
        """Right, down, and the logarithm of the distance."""
        self._lens = torch.zeros(count)
        self._lens_std = torch.tensor([STATED_FOCAL_STD if one else FOCAL_STD for one in stated or [False] * count])
        self._tilt = torch.zeros(count, 3)
        """Pitch, yaw and roll."""
        self._shape = torch.linalg.solve_triangular(
            shapes.scale, (start.betas - shapes.bias)[:, None], upper=False
        )[:, 0].clone()  # fmt: skip
        needed = _deviations(start) / NEEDED if prior_precision > 1 else torch.zeros(6, count)
        self._weights = (1 + needed.square()) ** -2
        self._weights[-1] = self._weights[0]  # a guess of the camera's height does not straighten a bow

    @torch.no_grad()
    def posture(self) -> Posture:
        """The posture so far."""
        return self._posture()

    def keep(self, numbers: Sequence[int]) -> None:
        """Go on with these of the pictures alone."""
        start = self._start
        pose, camera = (
            start.pose.map(lambda values: values[numbers]),
            start.camera.map(lambda values: values[numbers]),
        )
        self._start = Posture(pose, start.betas, camera)
        self._turn, self._move, self._lens, self._lens_std, self._tilt = (
            values[numbers] for values in (self._turn, self._move, self._lens, self._lens_std, self._tilt)
        )
        self._weights = self._weights[:, numbers]

    def refine(
        self,
        payload: Payload | Sequence[Payload],
        targets: Sequence[PosedView],
        stage: Stage,
        on_step: Callable[[], None] | None = None,
        *,
        shaped: bool = True,
    ) -> None:
        """Move to where the human's primitives look most like the pictures; deterministic on one machine.

        The human has one payload, or one in each picture. `targets` are of one size, and their cameras those of the
        posture so far, scaled; their frames do not count.
        `on_step` is called after each step; an exception that it raises cancels. `shaped`: betas move too.
        """
        upright = self._tilted and stage.upright
        others = [self._move, *[self._lens] * stage.upright, *[self._shape] * shaped, *[self._tilt] * upright]
        unknowns = [self._turn, *others]
        first, cameras = targets[0].camera, self.posture().camera
        scale = float(first.intrinsics[0, 0] / cameras.intrinsics[0, 0, 0])
        payloads = [payload] * len(targets) if isinstance(payload, Payload) else payload
        pictures = [_encoded(*target.rgba.split((3, 1), -1)) for target in targets]
        for value in unknowns:
            value.requires_grad_()
        adam = Adam.of(unknowns, ADAM_BETAS)
        for step in range(stage.steps):
            blur = stage.blur * max(first.width, first.height) * 0.5 ** (step / stage.steps)
            posture = self._posture()
            seen = zip(posture.frames(), payloads, each(resized(posture.camera, scale, first)), pictures, strict=True)
            errors = [_difference(*one, blur) for one in seen]
            priors = [self._turned() / self._joint_std, *others]
            prior = torch.cat([value.flatten() for value in priors]).square().sum() / 2
            if upright:
                prior = prior + (self._weights * _deviations(posture).square()).sum() / 2
            loss = DATA_WEIGHT * torch.stack(errors).sum() + prior
            adam.step(torch.autograd.grad(loss, unknowns), RATE * (1 - (1 - LAST_RATE) * step / stage.steps))
            if on_step is not None:
                on_step()
        for value in unknowns:
            value.requires_grad_(False)

    def _turned(self) -> Float[Tensor, "v 24 3"]:
        """Turns of the joints, radians. A body turns with its camera, so that a tilt hardly changes the picture."""
        start = self._start
        tilt = (TILT_STD * self._tilt)[:, None] @ start.camera.world_to_camera[:, :, :3]
        turn = self._turn * self._joint_std
        return torch.cat([turn[:, :1] - tilt @ start.pose.joint_rotation[:, 0], turn[:, 1:]], 1)

    def _posture(self) -> Posture:
        start, log_focal, log_depth = self._start, self._lens_std * self._lens, DEPTH_STD * self._move[:, 2]
        extrinsics = start.camera.world_to_camera
        pelvis = default_body().shape(start.betas).joints[0] + start.pose.translation
        before = (extrinsics[:, :, :3] @ pelvis[:, :, None])[..., 0] + extrinsics[:, :, 3]
        # A longer lens from farther away shows the same size, which separates focal length from distance.
        sideways = before[:, :2] * log_depth.exp()[:, None] + SIDEWAYS_STD_M * self._move[:, :2]
        place = torch.cat([sideways, (before[:, 2] * (log_depth + log_focal).exp())[:, None]], 1)
        # A tilted camera stays where it is, and the body moves to the same place in the picture.
        turn = axis_angle_to_matrix(TILT_STD * self._tilt)
        translation = (turn @ extrinsics[:, :, 3:])[..., 0]
        extrinsics = torch.cat([turn @ extrinsics[:, :, :3], translation[..., None]], -1)
        pelvis = ((place - translation)[:, None] @ extrinsics[:, :, :3])[:, 0]
        limit = torch.maximum(self._shapes.limit, start.betas.abs())
        betas = (self._shapes.bias + self._shapes.scale @ self._shape).clamp(-limit, limit)
        rotation = start.pose.joint_rotation @ axis_angle_to_matrix(self._turned())
        pose = BodyPose(rotation, pelvis - default_body().shape(betas).joints[0])
        focal = start.camera.intrinsics[..., :2] * log_focal.exp()[:, None, None]
        intrinsics = torch.cat([focal, start.camera.intrinsics[..., 2:]], -1)
        camera = dataclasses.replace(start.camera, intrinsics=intrinsics, world_to_camera=extrinsics)
        return Posture(pose, betas, camera)


def _deviations(posture: Posture) -> Float[Tensor, "6 v"]:
    return deviations(default_body().shape(posture.betas), posture.pose, posture.camera.position[:, 1])


def resized(camera: Camera, scale: float, like: Camera) -> Camera:
    """Cameras of pictures scaled from their upper left corner, of the size of another's."""
    intrinsics = torch.cat([scale * camera.intrinsics[..., :2, :], camera.intrinsics[..., 2:, :]], -2)
    return dataclasses.replace(camera, intrinsics=intrinsics, width=like.width, height=like.height)


def _difference(
    frames: Frames, payload: Payload, camera: Camera, picture: Float[Tensor, "4 H W"], blur: float
) -> Float[Tensor, ""]:
    """Squared differences of encoded colour over grey and of opacity, after a blur, per pixel of the figure."""
    seen = march(Primitives.place(frames, payload), camera, COARSE)
    return _blurred(_encoded(seen.rgb, seen.alpha[..., None]) - picture, blur).square().sum() / picture[3].sum()


@torch.no_grad()
def outline_error(payload: Payload, target: PosedView, blur: float = 0.0) -> float:
    """Mean squared difference of opacity, after a blur whose standard deviation is a share of the picture's side."""
    drawn = march(Primitives.place(target.frames, payload), target.camera, COARSE).alpha
    difference = (drawn - target.rgba[..., 3])[None]
    return float(_blurred(difference, blur * max(difference.shape)).square().mean())


def _encoded(rgb: Float[Tensor, "H W 3"], alpha: Float[Tensor, "H W 1"]) -> Float[Tensor, "4 H W"]:
    """Encoded colour over grey, and opacity."""
    return torch.cat([encode_srgb((rgb + (1 - alpha) * BACKGROUND).clamp(1e-4, 1)), alpha], -1).movedim(-1, 0)


def _blurred(picture: Float[Tensor, "c H W"], std: float) -> Float[Tensor, "c H W"]:
    """Gaussian blur; beyond the edges there is 0."""
    reach = max(1, round(2.5 * std))
    offsets = torch.arange(-reach, reach + 1, dtype=picture.dtype)
    kernel = torch.exp(-0.5 * (offsets / max(std, 1e-3)) ** 2)
    kernel = kernel / kernel.sum()
    across = torch.nn.functional.conv2d(picture[:, None], kernel[None, None, None], padding=(0, reach))
    return torch.nn.functional.conv2d(across, kernel[None, None, :, None], padding=(reach, 0))[:, 0]
