"""Multi-view captures: `primdiffusion captures` render, export, coco and farm."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import tyro
from tqdm import tqdm

from primdiffusion.body.model import BodyPose, read_motion
from primdiffusion.capture.camera_files import Project, export_cameras
from primdiffusion.capture.coco import ANNOTATIONS_FILE, write_coco
from primdiffusion.capture.farm import Farm, FarmResult, render_on
from primdiffusion.capture.poses import choose_poses
from primdiffusion.capture.reader import open_captures
from primdiffusion.capture.render import RenderJob, render
from primdiffusion.captured_humans import PASSES as PASSES_OF_VOLUMES
from primdiffusion.captured_humans import find_subjects, is_generated, read_subject, renderer_name
from primdiffusion.files.regular_files import printable
from primdiffusion.formats import capture_layout
from primdiffusion.formats.camera_rig import MOST_TOGETHER, Arrangement, Rig
from primdiffusion.formats.requests import FLOAT_DEPTH, PASSES
from primdiffusion.formats.schema import Range, check
from primdiffusion.training.captured_people import read_cards

DESCRIPTION = "Multi-view captures, to train on."


@dataclasses.dataclass(frozen=True)
class RenderCaptures:
    """Render humans of `primdiffusion people` and generated ones in many poses from many sides, unlit, without Blender.

    Finished subjects are skipped: running the command again resumes it.
    """

    people: Path
    """Folder of humans: those of `primdiffusion people`, and .human files; or one .human file."""
    out: Path
    """Output folder."""
    poses: tuple[Path, ...] = ()
    """Motion files (AMASS and other .npz, .npy, .json, .pkl, .bvh); the default is the built-in poses."""
    pose_count: int = 20
    """Poses of each human, the near-T pose first; 0: all frames of one motion file, in order, with its translation."""
    cameras: int = 36
    """Number of views of each pose."""
    size: int = 512
    """Width and height of the images, pixels."""
    arrangement: Arrangement = "rings"
    """Arrangement of the cameras."""
    elevations: tuple[float, ...] = (-10.0, 15.0, 40.0)
    """Elevations of the rings, degrees above the horizon."""
    passes: tuple[str, ...] | None = None
    """Passes to write; the default is all, and img, mask and depth if one of the humans is a generated one."""
    float_depth: bool = False
    """Also write depth as OpenEXR, float32: without the steps of 0.25 mm and the limit of 16 m that the PNGs have."""
    samples: int = 3
    """Samples along each side of a pixel, an odd number: 3 gives 9 samples per pixel. Generated humans take nine times
    as long with 3 as with 1."""
    seed: int = 0
    """Seed of the choice of poses."""
    workers: int = 1
    """Number of processes; each uses a core and about 1 GB."""
    together: Annotated[int, Range(1, MOST_TOGETHER)] = 1
    """Number of humans, 1 to 8, that stand together on a floor, in front of the same cameras; `coco` makes one image of
    them."""
    shard: str = "0/1"
    """i/n: only every n-th human from the i-th on, i = 0 ... n - 1, to share the work between machines."""
    released_reference: bool = False
    """Render the first human a second time, under the name that the released code expects."""

    def run(self) -> None:
        """Render, and print a line for each human.

        Raises:
            ValueError: settings are invalid, or a human could not be rendered (see the report).
        """
        check(self)
        index, count = parse_shard(self.shard)
        people = find_subjects(self.people)
        passes = self._passes(people)
        if self.released_reference:
            people = {**people, capture_layout.RELEASED_REFERENCE: next(iter(people.values()))}
        names = sorted(people)[index::count]
        if self.pose_count == 0 and len(self.poses) != 1:
            raise ValueError("pose_count 0 takes all frames of one motion file: give one with --poses")
        if self.released_reference and self.together > 1:
            raise ValueError("the released code expects its reference alone: leave out --together")
        job = RenderJob(
            people={name: people[name] for name in names},
            poses=self._chosen_poses(),
            out=self.out,
            rig=Rig(self.arrangement, self.cameras, self.elevations, width=self.size, height=self.size),
            passes=passes,
            samples=self.samples,
            seed=self.seed,
            released_reference=self.released_reference,
            together=self._groups(people) if self.together > 1 else (),
            read=read_subject,
            renderer=renderer_name(tuple(people.values())),
            part="report" if count == 1 else f"report-{index}-of-{count}",
        )
        outcomes = Counter()
        for outcome in tqdm(render(job, self.workers), total=len(names), unit="human", disable=None):
            outcomes[outcome.status] += 1
            said = outcome.error or f"{outcome.views} views"
            print(printable(f"{outcome.subject}  {outcome.status}  {said}"), flush=True)
        if outcomes["failed"]:
            raise ValueError(f"{outcomes['failed']} of {len(names)} humans failed: {self.out / job.part}.json says why")

    def _passes(self, people: Mapping[str, Path]) -> tuple[str, ...]:
        """Return the passes to write. Raises ValueError for those that a human does not have."""
        volume = next((name for name in sorted(people) if is_generated(people[name])), None)
        possible = PASSES if volume is None else PASSES_OF_VOLUMES
        if volume is not None and (missing := set(self.passes or ()) - set(possible)):
            raise ValueError(
                f"the generated human {volume} has no pass {', '.join(sorted(missing))}: choose from "
                f"{', '.join(possible)}"
            )
        passes = possible if self.passes is None else self.passes
        return (*passes, FLOAT_DEPTH) if self.float_depth else passes

    def _groups(self, people: Mapping[str, Path]) -> tuple[dict[str, Path], ...]:
        """Split all humans, of all shards, into groups by their names."""
        names = sorted(people)
        parts = [names[first : first + self.together] for first in range(0, len(names), self.together)]
        return tuple({name: people[name] for name in part} for part in parts)

    def _chosen_poses(self) -> BodyPose:
        """Return the poses. Raises as `read_motion` and `choose_poses`."""
        motions = [read_motion(path) for path in self.poses]
        return choose_poses(motions, self.pose_count, self.seed) if self.pose_count else motions[0]


def parse_shard(text: str) -> tuple[int, int]:
    """Parse "i/n" to i and n. Raises ValueError unless 0 <= i < n."""
    try:
        index, count = (int(number) for number in text.split("/"))
    except ValueError:
        index, count = -1, 0
    if not 0 <= index < count:
        raise ValueError(f"shard {text!r}: write i/n with i from 0 to n - 1, such as 0/4")
    return index, count


@dataclasses.dataclass(frozen=True)
class ExportCaptures:
    """Write camera files of NeRF (transforms.json), OpenCV and COLMAP beside the images."""

    root: tyro.conf.Positional[Path]
    """Folder of a capture dataset, of this program or in the released layout; the files go there."""
    projects: tuple[Project, ...] = ("nerf", "opencv", "colmap")
    """Programs to write files for."""

    def run(self) -> None:
        """Write, and print a line for each subject."""
        captures = open_captures(self.root)
        for name in tqdm(
            export_cameras(captures, self.projects), total=len(captures.subjects), unit="human", disable=None
        ):
            print(f"{self.root / name}  {', '.join(self.projects)}", flush=True)


@dataclasses.dataclass(frozen=True)
class AnnotateCaptures:
    """Write annotations in COCO's format (boxes, masks, 17 keypoints, SMPL)."""

    root: tyro.conf.Positional[Path]
    """Folder of a capture dataset, with images, masks and depth; the file goes there."""
    people: Path | None = None
    """Folder of `primdiffusion people` that the captures show: its attributes are annotated too."""

    def run(self) -> None:
        """Write the file, and print its path."""
        captures = open_captures(self.root)
        cards = {} if self.people is None else read_cards(self.people)
        attributes = {name: card.get("attributes", {}) for name, card in cards.items()}
        with tqdm(total=len(captures.subjects), unit="human", disable=None) as progress:
            write_coco(captures, attributes, lambda _: progress.update())
        print(self.root / ANNOTATIONS_FILE)


@dataclasses.dataclass(frozen=True, kw_only=True)
class FarmCaptures(Farm):
    """Render a dataset with Blender on a Ray cluster, one human per task (needs the extra `farm`).

    `primdiffusion captures farm --workers 4 -- blender -c primdiffusion capture --people scans --out captures`
    """

    command: tyro.conf.Positional[tuple[str, ...]]
    """The renderer and its options; paths must be the same on all machines."""

    def run(self) -> None:
        """Render, and print a line for each human. Raises ValueError if the cluster cannot start or a human fails."""

        def show(outcome: FarmResult, done: int, total: int) -> None:
            said = outcome.error or f"{outcome.seconds:.0f} s"
            print(printable(f"{done}/{total}  {outcome.subject}  {said}"), flush=True)

        outcomes = render_on(self, self.command, show)
        failed = [outcome.subject for outcome in outcomes if outcome.exit_code]
        if failed:
            raise ValueError(f"{len(failed)} of {len(outcomes)} humans are not finished: {', '.join(failed[:5])}")


Command = (
    Annotated[RenderCaptures, tyro.conf.subcommand("render")]
    | Annotated[ExportCaptures, tyro.conf.subcommand("export")]
    | Annotated[AnnotateCaptures, tyro.conf.subcommand("coco")]
    | Annotated[FarmCaptures, tyro.conf.subcommand("farm")]
)


def run(arguments: Sequence[str]) -> None:
    """Run a command line; raises its errors."""
    tyro.cli(Command, args=arguments or ["--help"], prog="primdiffusion captures", description=DESCRIPTION).run()
