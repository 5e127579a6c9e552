"""What to capture and how: one frozen record, checked when it is made."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, get_args

from ..formats.camera_rig import Rig, View
from ..formats.capture_layout import ENDINGS
from ..formats.group_places import MOST
from ..formats.joints import JOINT_NAMES
from ..formats.picture_files import DEPTH_UNIT
from ..formats.requests import FLOAT_DEPTH, LAYOUTS, PASSES

Light = Literal["uniform", "dome", "hdri"]
Background = Literal["black", "transparent", "hdri"]
HDRI_ENDINGS = (".hdr", ".exr")
Device = Literal["auto", "cpu", "gpu"]


@dataclasses.dataclass(frozen=True)
class CaptureSettings:
    """What to render of each subject. Raises ValueError for impossible settings."""

    out: Path
    """The dataset's folder."""
    seed: int = 0
    """Seed of the choice of poses, and of the noise of every view (`capture_layout.view_seed`)."""
    rig: Rig = dataclasses.field(default_factory=Rig)
    """Cameras around each subject; its picture size applies to `cameras` too."""
    cameras: tuple[View, ...] = ()
    """Fixed cameras for all subjects, instead of the rig's."""
    pose_files: tuple[Path, ...] = ()
    """Motion and pose files; empty for the built-in poses."""
    pose_count: int = 20
    passes: tuple[str, ...] = PASSES
    float_depth: bool = False
    """Adds the pass "depth_float": OpenEXR."""
    light: Light = "uniform"
    """uniform: every surface shows its own colour; dome: a white sky; hdri: the picture `hdri`."""
    hdri: Path | None = None
    """A picture, or a folder of which the seed of every view chooses one."""
    background: Background = "black"
    """transparent adds the pass "rgba", with straight alpha, hdri the pass "hdri", over the environment of the HDRI
    light; img stays over black."""
    samples: int = 16
    """Per pixel."""
    denoise: bool = False
    """Denoise img under a dome or HDRI light; other passes never are."""
    device: Device = "auto"
    threads: int = 0
    """Threads of Cycles on the CPU; 0 for all cores."""
    shard: tuple[int, int] = (0, 1)
    """(i, n): the subjects i, i + n, i + 2 n, ... of the sorted list."""
    together: int = 1
    """Subjects that stand together on a floor, in front of the same cameras; each is rendered alone."""
    shadows: bool = False
    """Whether subjects who stand together shade each other; the pictures differ in their colours alone."""
    layouts: tuple[str, ...] = LAYOUTS
    released_reference: bool = False
    """Whether the first subject is also stored under the name that the released code expects."""
    body: Path | None = None
    """The user's SMPL body, an .npz; None for the default body."""

    def __post_init__(self) -> None:
        index, count = self.shard
        wrong = {
            f"pass {next((kind for kind in self.passes if kind not in PASSES), 'none')}: choose of {', '.join(PASSES)}":
                not self.passes or not set(self.passes) <= set(PASSES),
            f"layouts {self.layouts}: choose of {', '.join(LAYOUTS)}": not set(self.layouts) <= set(LAYOUTS),
            f"light {self.light}: choose of {', '.join(get_args(Light))}": self.light not in get_args(Light),
            "the HDRI light needs a picture: name its file": self.light == "hdri" and self.hdri is None,
            "the background hdri needs the light hdri": self.background == "hdri" and self.light != "hdri",
            f"{self.hdri} holds no HDRI: choose a folder with .hdr or .exr pictures":
                self.light == "hdri" and self.hdri is not None and not self.hdris,
            f"background {self.background}: choose of {', '.join(get_args(Background))}":
                self.background not in get_args(Background),
            f"{self.samples} samples: one or more": self.samples < 1,
            f"{self.pose_count} poses: 1 to 10000": not 1 <= self.pose_count <= 10000,
            f"{self.together} together: 1 to {MOST}": not 1 <= self.together <= MOST,
            "the released code expects its reference alone: render it without together":
                self.together > 1 and self.released_reference,
            "people who stand together are rendered alone: put pictures behind them with captures coco --backgrounds":
                self.together > 1 and self.background == "hdri",
            "shadows between people need --together 2 or more, and the light dome or hdri":
                self.shadows and (self.together < 2 or self.light == "uniform"),
            f"shard {index}/{count}: 0/{count} to {count - 1}/{count}": not 0 <= index < count,
            f"{self.threads} threads: 0 (all) to 1024": not 0 <= self.threads <= 1024,
            f"device {self.device}: choose of {', '.join(get_args(Device))}": self.device not in get_args(Device),
        }  # fmt: skip
        for sentence, is_so in wrong.items():
            if is_so:
                raise ValueError(sentence)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the pictures."""
        return self.rig.width, self.rig.height

    @property
    def kinds(self) -> tuple[str, ...]:
        """The passes to write, the one that marks a view as done last."""
        last = "img" if "img" in self.passes else self.passes[-1]
        more = {"transparent": ["rgba"], "hdri": ["hdri"]}.get(self.background, []) + [FLOAT_DEPTH] * self.float_depth
        return (*(kind for kind in ENDINGS if kind in (*self.passes, *more) and kind != last), last)

    @property
    def hdris(self) -> tuple[Path, ...]:
        """The pictures of the HDRI light, sorted by name."""
        if self.hdri is None or not self.hdri.is_dir():
            return () if self.hdri is None else (self.hdri,)
        return tuple(sorted(path for path in self.hdri.iterdir() if path.suffix.lower() in HDRI_ENDINGS))

    @property
    def camera_count(self) -> int:
        """Cameras that see each pose."""
        return len(self.cameras) or self.rig.count

    def about(self, frames: int) -> dict[str, Any]:
        """The content of dataset.json, on which all runs that write to the dataset must agree."""
        return {
            "seed": self.seed,
            "rig": _about_views(self.cameras) if self.cameras else dataclasses.asdict(self.rig),
            "frames": frames,
            "passes": [kind for kind in ENDINGS if kind in self.kinds],
            "light": f"hdri:{self.hdri.name}" if self.light == "hdri" and self.hdri else self.light,
            "background": self.background,
            "renderer": "cycles",
            "samples": self.samples,
            "denoise": self.denoise,
            "world": "metres, y up, facing +z",
            "depth": {"kind": "z", "unit_m": DEPTH_UNIT},
            "part_names": list(JOINT_NAMES),
            "released_reference": self.released_reference,
            **({"together": self.together} if self.together > 1 else {}),
            **({"shadows": True} if self.shadows else {}),
            **({"hdris": [path.name for path in self.hdris]} if self.hdri and self.hdri.is_dir() else {}),
        }


def _about_views(views: Sequence[View]) -> dict[str, Any]:
    digest = hashlib.sha256()
    for view in views:
        for array in (view.intrinsics, view.rotation, view.translation):
            digest.update(array.round(9).tobytes())
    first = views[0]
    return {
        "arrangement": "custom",
        "count": len(views),
        "width": first.width,
        "height": first.height,
        "digest": digest.hexdigest()[:16],
    }
