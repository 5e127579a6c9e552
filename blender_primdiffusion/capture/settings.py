"""What to capture and how: one frozen record, checked when it is made."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from ..files.picture_files import DEPTH_UNIT
from ..formats.camera_rig import MOST_TOGETHER, Rig, View
from ..formats.capture_layout import ENDINGS
from ..formats.joints import JOINT_NAMES
from ..formats.requests import FLOAT_DEPTH, PASSES, Count, Seed
from ..formats.schema import Range, Slider, check

Light = Literal["uniform", "dome", "hdri"]
Background = Literal["black", "transparent", "hdri"]
HDRI_ENDINGS = (".hdr", ".exr")
Device = Literal["auto", "cpu", "gpu"]


@dataclasses.dataclass(frozen=True)
class CaptureSettings:
    """What to render of each subject. Raises ValueError for impossible settings."""

    out: Path
    """The dataset's folder."""
    seed: Seed = 0
    """Seed of the choice of poses, and of the noise of every view."""
    rig: Rig = dataclasses.field(default_factory=Rig)
    """Cameras around each subject; its picture size applies to `cameras` too."""
    cameras: tuple[View, ...] = ()
    """Fixed cameras for all subjects, instead of the rig's."""
    pose_files: tuple[Path, ...] = ()
    """Motion and pose files; empty for the built-in poses."""
    pose_count: Annotated[int, Range(1, 10_000), Slider(1, 100)] = 20
    """Number of poses; the first is near the T pose."""
    passes: tuple[str, ...] = PASSES
    """Kinds of pictures to write."""
    float_depth: bool = False
    """Also write depth as OpenEXR, float32."""
    light: Light = "uniform"
    """Lighting. uniform: every surface shows its own colour; dome: a white sky; hdri: an environment picture."""
    hdri: Path | None = None
    """Environment picture, .exr or .hdr, or a folder of them, of which the seed of every view chooses one."""
    background: Background = "black"
    """What is behind people in one more pass: "rgba" (transparent, straight alpha) or "hdri" (the HDRI light); img
    stays over black."""
    samples: Annotated[Count, Slider(1, 1024)] = 16
    """Samples of each pixel."""
    denoise: bool = False
    """Denoise colours under a dome or HDRI light; never masks, depth, normals or parts."""
    device: Device = "auto"
    """Device on which Cycles renders."""
    threads: Annotated[int, Range(0, 1024)] = 0
    """Threads of Cycles on the CPU; 0 for all cores."""
    shard: tuple[int, int] = (0, 1)
    """(i, n): the subjects i, i + n, i + 2 n, ... of the sorted list."""
    together: Annotated[int, Range(1, MOST_TOGETHER)] = 1
    """Number of people who stand together on a floor, in front of the same cameras; each is rendered alone."""
    released_reference: bool = False
    """Also store the first subject under the name that the released code expects."""
    body: Path | None = None
    """SMPL body, an .npz of plain arrays; the bundled body by default."""

    def __post_init__(self) -> None:
        check(self)
        index, count = self.shard
        wrong = {
            f"pass {next((kind for kind in self.passes if kind not in PASSES), 'none')}: choose of {', '.join(PASSES)}":
                not self.passes or not set(self.passes) <= set(PASSES),
            "the HDRI light needs a picture: name its file": self.light == "hdri" and self.hdri is None,
            "the background hdri needs the light hdri": self.background == "hdri" and self.light != "hdri",
            f"{self.hdri} holds no HDRI: choose a folder with .hdr or .exr pictures":
                self.light == "hdri" and self.hdri is not None and not self.hdris,
            "the released code expects its reference alone: render it without together":
                self.together > 1 and self.released_reference,
            "people who stand together are rendered alone: put pictures behind them with captures coco --backgrounds":
                self.together > 1 and self.background == "hdri",
            f"shard {index}/{count}: 0/{count} to {count - 1}/{count}": not 0 <= index < count,
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
