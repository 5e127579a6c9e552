"""Messages of the child: answers to the requests of `requests`, errors, and notifications. Each is declared here, once.

Fields without a default are those that the extension needs; it reads the answers of other versions too.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

from .schema import Open, Range

Count = Annotated[int, Range(0)]
Seconds = Annotated[float, Range(0, 2**63)]
Percent = Annotated[int, Range(0, 100)]


@dataclasses.dataclass(frozen=True, kw_only=True)
class HumanAnswer(Open):
    """The files of a human."""

    person: Path
    """The .human.safetensors file; beside it body.safetensors, for a human on a body of the user's files."""
    seconds: Seconds
    preview: Path | None = None
    """The human from the front, PNG."""
    side: Path | None = None
    depth: Path | None = None
    warnings: list[str] = dataclasses.field(default_factory=list)
    """Sentences, such as on attributes that the human does not show."""
    seed: Count | None = None
    """None where nothing is drawn at random."""
    steps: Count | None = None
    edit: str | None = None
    """Kind of the edit; None for a new human."""

    def __str__(self) -> str:
        """Format for the command line."""
        made = f"seed {self.seed}, {self.steps} steps" if self.edit is None else self.edit
        return f"{self.person.parent}  {made}, {self.seconds:.1f} s"


@dataclasses.dataclass(frozen=True, kw_only=True)
class VariationFiles(Open):
    """Files of one of several humans."""

    seed: Count
    person: Path
    picture: Path


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReconstructAnswer(HumanAnswer):
    """A reconstructed human."""

    subject: str | None = None
    frame: Count | None = None
    views: list[Count] | None = None
    """Numbers of the cameras."""
    posture: Path | None = None
    """posture.json: pose, shape and cameras in pictures; None for captures."""
    fit: Percent | None = None
    """Quality of the fit, percent: how well the body in that posture explains the pictures. None for captures."""
    backs: list[VariationFiles] = dataclasses.field(default_factory=list)
    """Further humans of the same pictures, seen from behind."""

    def __str__(self) -> str:
        """Format for the command line."""
        seen = (
            "pictures" if self.subject is None else f"{self.subject}, frame {self.frame}, {len(self.views or ())} views"
        )
        fit = "" if self.fit is None else f", fit {self.fit} %"
        return f"{self.person.parent}  {seen}{fit}, {self.seconds:.1f} s"


@dataclasses.dataclass(frozen=True, kw_only=True)
class FitPostureAnswer(Open):
    """A refined posture."""

    posture: Path
    """posture.json."""
    seconds: Seconds
    warnings: list[str]
    """Sentences."""
    fit: Percent | None = None
    """Quality of the fit, percent: how well the body in that posture explains the pictures."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class VariationsAnswer(Open):
    """Several humans, in the order of their seeds."""

    people: list[VariationFiles]
    seconds: Seconds
    warnings: list[str] = dataclasses.field(default_factory=list)
    """Sentences on humans that do not show what was asked for, which name their seeds."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class AttributesAnswer(Open):
    """The attributes that a model knows."""

    categories: dict[str, list[str]]
    """Values by name."""
    scalars: dict[str, list[float]]
    """Mean and standard deviation by name."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RenderAnswer(Open):
    """Pictures of a human."""

    out: Path | None = None
    seconds: Seconds | None = None

    def __str__(self) -> str:
        """Format for the command line."""
        return str(self.out)


@dataclasses.dataclass(frozen=True, kw_only=True)
class DrawAnswer(Open):
    """A frame is filled."""

    seconds: Seconds | None = None
    seconds_place: Seconds | None = None
    """Loading and placing."""
    seconds_march: Seconds | None = None
    """The marcher alone."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class MergeAnswer(Open):
    """A grid for each frame: density float16 [X, Y, Z] (1/m), colour float16 [X, Y, Z, 3] (linear), origin [3] (the
    centre of the first voxel), voxel; z up."""

    files: list[Path]
    seconds: Seconds


@dataclasses.dataclass(frozen=True, kw_only=True)
class ProxyAnswer(Open):
    """The textured mesh of a human."""

    proxy: Path
    """An .npz of the human in the T pose as one closed mesh; vertices [V, 3], faces [F, 3], uv_corner [F, 3, 2],
    skin_weights [V, 24], joints [24, 3]; y up."""
    texture: Path
    """PNG, sRGB."""
    triangles: Count
    betas: list[float]
    """Shape coefficients of the mesh."""
    seconds: Seconds


@dataclasses.dataclass(frozen=True, kw_only=True)
class GaussiansAnswer(Open):
    """A file of 3D Gaussians."""

    out: Path
    gaussians: Count
    """Their number."""
    seconds: Seconds | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Ready(Open):
    """Notification: torch is loaded, or `problem` says why it cannot be."""

    ready: bool = False
    problem: str | None = None
    torch: str | None = None
    device: str | None = None
    device_name: str | None = None
    device_memory_gb: float | None = None
    device_memory_free_gb: float | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class HelloAnswer(Ready):
    """About the child; what torch reports is absent until it is loaded."""

    name: str | None = None
    version: str | None = None
    protocol: int | None = None
    pid: int | None = None
    python: str | None = None
    executable: str | None = None
    memory_gb: float | None = None
    memory_free_gb: float | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class CancelAnswer(Open):
    """Answer to a cancellation."""

    cancelled: bool = False


@dataclasses.dataclass(frozen=True, kw_only=True)
class Done(Open):
    """An answer without values."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Progress(Open):
    """Notification: a running request has come to a step of a stage."""

    id: int | str | float | None
    """The request's."""
    stage: str
    step: Count
    total: Count
    eta_s: Seconds | None = None
    """Seconds left; None while unknown."""
    picture: Path | None = None
    """A new preview, PNG. Read it immediately: it is deleted when newer ones arrive."""
    index: Count | None = None
    """The human that the preview shows, of several."""
    human: HumanAnswer | None = None
    """A finished human, of several; the last is the answer."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ErrorData(Open):
    """About an error, for programs."""

    kind: str = ""
    remedy: str = ""
    """Next step; empty where the message says it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Failure(Open):
    """The error of a request."""

    code: int
    message: str
    data: ErrorData | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Message(Open):
    """A line of the child: a notification, which has a method, or else an answer."""

    id: int | None = None
    method: str | None = None
    params: dict | None = None
    result: dict | None = None
    error: Failure | None = None


ANSWERS: dict[str, type] = {
    "hello": HelloAnswer,
    **dict.fromkeys(("generate", "vary", "interpolate", "inpaint", "transfer"), HumanAnswer),
    "variations": VariationsAnswer,
    "attributes": AttributesAnswer,
    "reconstruct": ReconstructAnswer,
    "fit_posture": FitPostureAnswer,
    "render": RenderAnswer,
    "draw": DrawAnswer,
    "merge": MergeAnswer,
    "proxy": ProxyAnswer,
    "gaussians": GaussiansAnswer,
    "cancel": CancelAnswer,
    "shutdown": Done,
}
"""Answers by the method of their request."""
NOTIFICATIONS: dict[str, type] = {"ready": Ready, "progress": Progress, "heartbeat": Done}
"""Messages that answer no request, by their method."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class CapturesProgress(Open):
    """Progress of the Blender that renders captures, or a line for the user alone."""

    subject: str = ""
    done: Count = 0
    total: Count = 0
    eta_s: Seconds | None = None
    news: list[str] = dataclasses.field(default_factory=list)
    """Lines for the user."""
    line: str | None = None
