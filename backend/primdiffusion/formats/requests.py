"""Requests as the command line, JSON-RPC and the extension know them: each is declared here, once.

A field's annotation holds its limits, the string below it its description (see `schema`).
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Literal, get_args

from .joints import JOINT_NAMES
from .schema import Checked, Ending, FieldError, Length, Option, Range, Shape, Slider

Sampler = Literal["dpmpp_2m", "ddim", "ddpm"]
SAMPLERS: tuple[Sampler, ...] = get_args(Sampler)
Transfer = Literal["texture", "garment"]
TRANSFERS: tuple[Transfer, ...] = get_args(Transfer)
InpaintMethod = Literal["repaint", "released"]
Compositing = Literal["linear", "released"]
"""Appearance of pictures: as in Blender, or as the authors' code draws them."""
View = Literal["colour", "depth", "alpha", "boxes"]
VIEWS: tuple[View, ...] = get_args(View)
WHOLE_PARTS = (
    "face", "hair", "neck", "torso", "upper_arms", "forearms", "hands", "thighs", "shins", "feet", "hips",
    "head", "arms", "legs", "top", "bottom", "shoes", "clothes", "skin",
)  # fmt: skip
SIDED_PARTS = (
    "left_upper_arm", "right_upper_arm", "left_forearm", "right_forearm", "left_hand", "right_hand",
    "left_thigh", "right_thigh", "left_shin", "right_shin", "left_foot", "right_foot",
)  # fmt: skip
"""Left and right as seen by the human."""
PARTS = (*WHOLE_PARTS, *SIDED_PARTS)
"""Body parts that regions consist of."""
Reconstruction = Literal["encoder", "prior"]
"""Method that turns views into a human."""
PASSES = ("img", "mask", "depth", "normal", "part")
"""Images of a captured view."""
FLOAT_DEPTH = "depth_float"
"""Further image, written only if asked for."""
RAY_STEP = 0.004
"""Metres between samples of a ray."""
DENSITY_GAIN = 1.6
"""Factor on density for renderers with exponential absorption."""
VOXEL = 0.006
"""Voxel size of merged grids and of the grid for proxies, metres. Half of it resolves more of the primitives' own
voxels (2 to 14 mm) at eight times the memory."""
LARGEST_SEED = 2**63 - 1

Seed = Annotated[int, Range(0, LARGEST_SEED)]
Fraction = Annotated[float, Range(0, 1)]
Pixels = Annotated[int, Range(1, 65_536)]
StepPixels = Annotated[int, Range(0, 1024), Option(hidden=True)]
"""Larger previews would delay sampling and cancelling."""
Voxel = Annotated[float, Range(1e-4, 10.0)]
RayStep = Annotated[float, Range(1e-4, 1.0)]
"""Finer steps take hours without visible gain."""
Count = Annotated[int, Range(1)]
NotNegative = Annotated[float, Range(0, 1e30)]
Positive = Annotated[float, Range(1e-12, 1e30)]
Text = Annotated[str, Length(1, 200)]
Attributes = dict[Text, Text | float]
OutDir = Annotated[Path, Option(name="out")]
Person = Annotated[Path, Option(positional=True)]
Matrix = Annotated[list, Shape((3, 4))]
JointMatrices = Annotated[list, Shape((len(JOINT_NAMES), 3, 4))]


def check_seed(seed: int) -> None:
    """Raise ValueError outside 0 ... 2^63-1."""
    if not 0 <= seed <= LARGEST_SEED:
        raise FieldError(("seed",), f"{seed} is outside 0 ... 2^63-1")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sampling:
    """Fields of requests that denoise."""

    steps: Annotated[int, Range(1, 1000), Slider(1, 100)] = 20
    """Denoising steps: more take longer and add detail."""
    checkpoint: Path | None = None
    """Trained model (.safetensors); the default is the one in the package."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Conditioning:
    """Fields of requests that take attributes."""

    attributes: Attributes = dataclasses.field(default_factory=dict)
    """Attributes, NAME=VALUE: sex=female "outfit=blouse and skirt" height=1.7. `info` lists the names and values that a
    checkpoint knows."""
    guidance: Annotated[float, Range(0, 20), Slider(1, 5)] = 2.0
    """Strength of attributes (classifier-free guidance), also of those that the seed chooses: 1 follows the training
    data; more exaggerates and costs variety."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Previews:
    """Fields of requests that write the files of a human."""

    out_dir: OutDir
    """Output folder, created if missing: person.human.safetensors and previews; for a body of the user's files
    also body.safetensors, for Blender."""
    size: Pixels = 512
    """Width and height of the previews, pixels."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class StepPreviews(Sampling, Previews):
    """Fields of requests that sample one human."""

    picture_px: StepPixels = 0
    """Width and height of previews while sampling, pixels; 0 for none."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class GenerateRequest(StepPreviews, Conditioning):
    """Generate humans: person.human.safetensors and previews."""

    seed: Seed = 0
    """Another seed gives another human; the same seed gives the same human."""
    count: Count = 1
    """Number of humans, with consecutive seeds; several are in a folder each, seed_000000 and so on."""
    batch: Count = 1
    """Humans sampled at once: faster, above all on a GPU, and needs more memory. Results differ from those of single
    humans in the last digits."""
    compact: bool = False
    """Store colours and densities of person.human.safetensors in 8 bits: 2 MB instead of 8, without visible loss."""
    sampler: Sampler = "dpmpp_2m"
    """dpmpp_2m: few steps; ddim: more for humans that differ as much; ddpm: the paper's, needs hundreds."""
    compositing: Compositing = "linear"
    """linear: previews as in Blender; released, as the authors' code: previews of sRGB-encoded colours, boxes in index
    order, and the sampler ddim stops at the schedule's lowest level of noise instead of at none."""

    def check(self) -> None:
        """Raise FieldError for seeds beyond the largest."""
        if self.seed + self.count - 1 > LARGEST_SEED:
            raise FieldError(("count",), f"is {self.count}: the last seed would be above 2^63 - 1")


@dataclasses.dataclass(frozen=True, kw_only=True)
class VariationsRequest(Sampling, Conditioning):
    """Generate several humans, or variants of one, as one batch, each with a preview to choose by."""

    seeds: Annotated[list[Seed], Length(1, 64)]
    """Different seeds. They are sampled as one batch: memory grows with their number."""
    out_dir: Path
    """Output folder, created if missing, for SEED.human.safetensors and SEED.png of each."""
    sampler: Sampler = "dpmpp_2m"
    size: Annotated[int, Range(2, 1024)] = 256
    """Width and height of the previews, pixels."""
    person: Path | None = None
    """A .human.safetensors file: generate variants of this human, as `vary` does, instead of new humans."""
    amount: Fraction = 0.5
    """Difference of the variants from this human: 0 none, 1 almost complete."""

    def check(self) -> None:
        """Raise FieldError for a seed that is given twice."""
        if len(set(self.seeds)) < len(self.seeds):
            raise FieldError(("seeds",), "has two that are equal: give each once")


@dataclasses.dataclass(frozen=True, kw_only=True)
class AttributesRequest:
    """Return the attributes a model can be conditioned on: values of categories, mean and deviation of scalars."""

    checkpoint: Path | None = None
    """Trained model (.safetensors); the default is the one in the package."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class EditRequest(StepPreviews):
    """Fields that all edits share."""

    person: Person
    """A .human.safetensors file; it is not changed."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class VaryRequest(EditRequest, Conditioning):
    """Generate a variant of a human: the same body with other clothes and another face."""

    amount: Fraction = 0.5
    """Difference of the new human from this one: 0 none, 1 almost complete."""
    seed: Seed = 0
    """Another seed gives another result; the same seed gives the same result."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class InterpolateRequest(EditRequest):
    """Interpolate between two humans: plausible at every fraction, with a body in between."""

    other: Person
    """A second .human.safetensors file."""
    fraction: Fraction = 0.5
    """Fraction of the other human: 0 is exactly this human, 1 exactly the other."""

    def check(self) -> None:
        """Raise FieldError for a single step."""
        if self.steps < 2:
            raise FieldError(("steps",), f"is {self.steps}: interpolation takes 2 or more")


@dataclasses.dataclass(frozen=True, kw_only=True)
class RegionRequest(EditRequest):
    """Fields of edits of a region; everything outside stays bit-identical."""

    region: list[Text] = dataclasses.field(default_factory=list)
    """Body parts by name, such as top, bottom, shoes, hair, left_hand (docs/design/diffusion_edits.md)."""
    weights: Path | None = None
    """Instead of region: an .npz with `weights`, a number from 0 to 1 for each vertex of the body."""
    seed: Seed = 0
    """Another seed gives another result; the same seed gives the same result."""

    def check(self) -> None:
        """Raise FieldError unless the region is given in exactly one way."""
        if bool(self.region) == (self.weights is not None):
            raise FieldError(("region",), "and weights exclude each other: give names of parts, or a file of weights")


@dataclasses.dataclass(frozen=True, kw_only=True)
class InpaintRequest(RegionRequest, Conditioning):
    """Resample a region of a human so that it fits the rest, for other clothes or hair."""

    masking: InpaintMethod = "repaint"
    """repaint: the rest is noised to each step's own level, and each step is sampled twice; released: as in the
    authors' code, the rest is pasted one level too noisy, and each step is sampled once."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TransferRequest(RegionRequest):
    """Copy the appearance of a region from another human. Checkpoint, seed and steps apply to harmonising."""

    source: Path
    """A .human.safetensors file to copy from."""
    what: Transfer = "texture"
    """texture: colours only, for garments of the same cut; garment: shape too."""
    harmonise: Fraction = 0.0
    """Strength of harmonising: the region is noised and denoised again to match the rest; 0 copies it exactly."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Pictures:
    """Fields of requests that take plain pictures of one person."""

    pictures: Annotated[tuple[Path, ...], Option(positional=True)] = ()
    """PNG or JPEG files of one person, who is marked by alpha or by `masks`."""
    masks: tuple[Path, ...] = ()
    """A mask for each picture, of its size: opaque or white where the person is. Pictures with alpha need none,
    nor does a single picture with a posture of its own camera, which cuts the person out (extra cutout) to mask.png."""
    mask_label: Annotated[int, Range(0, 65535)] | None = None
    """The person's label in masks of labels: the index in their palette, or else the grey value."""
    pose: Path | None = None
    """Pose file: one pose for each picture or one for all (.json, .npz, .npy, .pkl, .bvh), or a posture.json; without
    it, the person is taken to stand upright, facing the camera; in several pictures, any way."""
    cameras: Path | None = None
    """Cameras of the pictures, as a cameras.json of captures; without it, the lens is that of the EXIF data or a usual
    one, and the distance follows from the person's size in the picture."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReconstructRequest(Previews, Pictures):
    """Reconstruct a human from plain pictures or from captures: person.human.safetensors and previews.

    One picture is enough. Pose, shape and cameras are refined, starting from files or from a standing body, and are
    written to posture.json; what no picture shows is guessed. From captures, whose poses and cameras are known, views
    are those of one frame: captures of `primdiffusion captures`, of Blender's Render Captures, or a dataset in the
    released code's layout. Nothing is trained for a person.
    """

    refine: bool = True
    """Whether pose, shape and cameras of pictures are refined; otherwise a pose file and cameras are needed."""
    seed: Seed | None = None
    """Draws what no picture shows; without it, that is the most probable."""
    backs: Annotated[int, Range(0, 16)] = 0
    """Number of further humans of the same pictures to choose from: SEED.human.safetensors, and SEED.png from behind.
    They draw what no picture shows by the seeds after `seed`, or from 0 on."""
    capture: Path | None = None
    """Folder of a capture dataset, or of one subject in it."""
    subject: str | None = None
    """Name of the subject; not needed if there is only one."""
    frame: Annotated[int, Range(0)] = 0
    """Captured pose to use; 0 is near the T pose, which shows most of a human."""
    views: Annotated[int, Range(1)] = 8
    """Number of cameras, spread around the human; all if there are fewer."""
    by: Reconstruction = "encoder"
    """encoder: a network turns several views into a human within seconds; prior: the human is fitted to the views, and
    what they do not show is the most probable for the diffusion model, so one view is enough, as for pictures."""
    checkpoint: Path | None = None
    """Trained encoder, or diffusion model for `by` prior and for pictures (.safetensors); the default is the one in the
    package."""

    def check(self) -> None:
        """Raise FieldError unless there is either a capture or at least one picture."""
        if bool(self.pictures) == (self.capture is not None):
            raise FieldError(("capture",), "and pictures exclude each other: give a folder of captures, or pictures")
        if self.seed is not None and not self.pictures and self.by != "prior":
            raise FieldError(("seed",), "has no effect on the encoder: leave it out, or reconstruct by prior")
        if self.backs and not self.pictures:
            raise FieldError(("backs",), f"is {self.backs}, but only pictures have backs to choose from: leave it out")
        if (self.seed or 0) + self.backs > LARGEST_SEED:
            raise FieldError(("backs",), f"is {self.backs}: the last seed would be above 2^63 - 1")


@dataclasses.dataclass(frozen=True, kw_only=True)
class FitPostureRequest(Pictures):
    """Refine pose, shape and cameras of the person in pictures."""

    out_dir: OutDir
    """Output folder, for posture.json."""
    checkpoint: Path | None = None
    """Trained diffusion model (.safetensors); the default is the one in the package."""

    def check(self) -> None:
        """Raise FieldError without a picture."""
        if not self.pictures:
            raise FieldError(("pictures",), "is empty: give at least one")


@dataclasses.dataclass(frozen=True, kw_only=True)
class PoseOptions:
    """Fields of requests that take a pose."""

    pose: Path | None = None
    """Pose file (.npz, .npy, .json, .pkl, .bvh), such as 72 axis-angle numbers (24 x 3, radians); default: T pose."""
    frame: int = 0
    """Frame of a pose file with several."""
    tracked_person: str = ""
    """Name or number of a person in a tracker's pose file of several people; default: who is in the most frames."""

    def check(self) -> None:
        """Raise FieldError for a frame or person without a pose file."""
        for name, value in (("frame", self.frame), ("tracked_person", self.tracked_person)):
            if value and self.pose is None:
                raise FieldError((name,), f"is {value} without a pose file: give one with --pose")


@dataclasses.dataclass(frozen=True, kw_only=True)
class RenderRequest(PoseOptions):
    """Render a human in a pose."""

    human: Person
    """A .human.safetensors file."""
    out: Annotated[Path, Ending((".png",))]
    """Output PNG."""
    yaw_degrees: Annotated[float, Range(-1e30, 1e30), Option(name="yaw")] = 0.0
    """Camera position around the human, degrees: 0 in front, 90 at the human's left."""
    size: Pixels = 512
    """Width and height, pixels."""
    width: Pixels | None = None
    """Pixels; the default is the size."""
    height: Pixels | None = None
    """Pixels; the default is the size."""
    view: View = "colour"
    """colour; depth in false colours, bright where near; alpha in grey; boxes: the primitives."""
    step: RayStep = RAY_STEP
    """Metres between samples of a ray; finer is slower and more accurate."""
    compositing: Compositing = "linear"
    """linear, as in Blender; released, as the authors' code: sRGB-encoded colours, boxes in index order, a sample each
    millimetre, rays through pixel corners."""
    background: Literal["black", "white", "transparent"] = "black"
    """Background behind the human."""

    def check(self) -> None:
        """Raise FieldError for what `released` does not have, and as `PoseOptions`."""
        super().check()
        if self.compositing == "released" and (self.view, self.step) != ("colour", RAY_STEP):
            raise FieldError(
                ("compositing",), "is released, which has its own step and the view colour: omit the others"
            )


@dataclasses.dataclass(frozen=True)
class PosedPerson:
    """A human posed by an armature."""

    human: Path
    """A person.human.safetensors file."""
    object: Matrix
    """[3][4] world matrix of the armature object; y up, metres."""
    joints: JointMatrices
    """[24][3][4] rest to posed in object space, SMPL's joint order."""
    betas: list[float] | None = None
    """Shape coefficients; None for those of the file."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class DrawRequest:
    """Draw posed humans into a mapped file, for the render engine and viewport. Needs no checkpoint."""

    frame: Path
    """A file of (4 + 1) w h float32 to map and fill: premultiplied linear RGBA, then depth; bottom row first. w and h
    are those of the region."""
    width: Pixels
    """Width and height of the whole image, pixels."""
    height: Pixels
    intrinsics: Annotated[list, Shape((3, 3))]
    """[3][3] of the whole image, in pixels from its top left corner, pixel centres at +0.5."""
    world_to_camera: Matrix
    """[3][4], OpenCV; y up, metres."""
    people: list[PosedPerson]
    region: Annotated[list[int], Length(4, 4)] | None = None
    """[x, y, w, h], pixels from the left and from the bottom; None for the whole image."""
    clip: Annotated[list, Shape((2,))] = dataclasses.field(default_factory=lambda: [0.0, 1e10])
    """[start, end], metres along the optical axis."""
    solids: Path | None = None
    """An npz of corners [F, 3, 3], colour [F, 3] and holdout [F]."""
    background: Annotated[list, Shape((3,))] | None = None
    """[r, g, b], linear; None for a transparent background."""
    view: View = "colour"
    """Colours, depth in false colours, alpha in grey, or the primitives as boxes."""
    step: RayStep = RAY_STEP
    """Metres between samples of a ray through humans of natural size; scaled humans are sampled in proportion."""

    def check(self) -> None:
        """Raise FieldError for a camera that no picture has, and a region outside the picture."""
        (fx, _, _), (below, fy, _), last = self.intrinsics
        if not (fx > 0 and fy > 0 and below == 0 and last == [0, 0, 1]):
            problem = f"is {self.intrinsics}: give [[fx, skew, cx], [0, fy, cy], [0, 0, 1]] with fx and fy above zero"
            raise FieldError(("intrinsics",), problem)
        if not 0 <= self.clip[0] < self.clip[1]:
            raise FieldError(("clip",), f"is {self.clip}: give [start, end] in metres with 0 <= start < end")
        x, y, w, h = self.region or (0, 0, self.width, self.height)
        if not (x >= 0 and y >= 0 and w >= 1 and h >= 1 and x + w <= self.width and y + h <= self.height):
            problem = (
                f"is {self.region}: give [x, y, w, h] with w and h of 1 or more, inside the picture of "
                f"{self.width} x {self.height}"
            )
            raise FieldError(("region",), problem)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the drawn region."""
        return (self.width, self.height) if self.region is None else (self.region[2], self.region[3])

    @property
    def corner(self) -> tuple[int, int]:
        """The region's top left pixel in the whole image, from the left and top."""
        return (0, 0) if self.region is None else (self.region[0], self.height - self.region[1] - self.region[3])


@dataclasses.dataclass(frozen=True, kw_only=True)
class MergeRequest:
    """Write a voxel grid for each frame of a human. Needs no checkpoint."""

    people: Annotated[list[PosedPerson], Length(1)]
    """The same human, once for each frame."""
    out_dir: Path
    """Output folder of 0000.npz, 0001.npz, ...; created if missing."""
    voxel: Voxel = VOXEL
    """Voxel size, metres; half the size shows more detail at eight times the memory."""


@dataclasses.dataclass(frozen=True)
class ProxySettings:
    """Resolution of the textured mesh of a human."""

    spacing: Annotated[float, Range(0.003, 0.05)] = VOXEL
    """Spacing of the grid that the surface is extracted from, metres."""
    triangles: Annotated[int, Range(500, 1_000_000)] = 20_000
    """Largest number of triangles of the mesh."""
    texture_px: Annotated[int, Range(64, 8192), Option(name="texture")] = 1024
    """Width and height of the texture, pixels. Texels of 2 mm resolve the primitives' voxels: twice as many, enlarged
    from these, differ by 0.5 of 255 levels (RMS)."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ProxyRequest(ProxySettings):
    """Write the textured mesh of a human in the rest pose."""

    person: Path
    """A .human.safetensors file."""
    out_dir: Path
    """Output folder of proxy.npz and proxy.png; created if missing."""
    betas: list[float] | None = None
    """Shape coefficients; None for those of the file."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class GaussiansRequest:
    """Write a human as 3D Gaussians, posed by an armature."""

    person: PosedPerson
    """The human and its pose."""
    out: Annotated[Path, Ending((".ply",))]
    """Output .ply."""
    limit: Annotated[int, Range(1)] = 400_000
    """Largest number of Gaussians; about 130,000 of a human are visible."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class EncodeSettings(Checked):
    """Settings of the encoder that turns captures into payloads."""

    views: Count = 8
    """Images to encode, spread around the subject; all if there are fewer."""
    looks: Count = 1
    """Frames of each subject to encode, evenly spaced; the first, near the T pose, has the least occlusion."""
    refine_steps: Annotated[int, Range(0)] = 0
    """Refinement steps on all images of the subject, which restore detail that the encoder blurs, such as 300; 0 for
    none."""
    refine_size: Pixels = 256
    """Largest side of the images used in refinement, pixels."""
    seed: Seed = 0
    """Seed of the order of images in refinement."""


@dataclasses.dataclass(frozen=True)
class CancelRequest:
    """Stop a running request."""

    id: str | int | float
    """The request's id."""


@dataclasses.dataclass(frozen=True)
class NoParameters:
    """Parameters of hello and shutdown."""


REQUESTS: dict[str, type] = {
    "hello": NoParameters,
    "generate": GenerateRequest,
    "variations": VariationsRequest,
    "attributes": AttributesRequest,
    "vary": VaryRequest,
    "interpolate": InterpolateRequest,
    "inpaint": InpaintRequest,
    "transfer": TransferRequest,
    "reconstruct": ReconstructRequest,
    "fit_posture": FitPostureRequest,
    "render": RenderRequest,
    "draw": DrawRequest,
    "merge": MergeRequest,
    "proxy": ProxyRequest,
    "gaussians": GaussiansRequest,
    "cancel": CancelRequest,
    "shutdown": NoParameters,
}
"""Requests by the method of JSON-RPC."""
