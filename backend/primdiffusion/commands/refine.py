"""A captured person in all their detail: `primdiffusion refine`."""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import tyro
from tqdm import tqdm

if TYPE_CHECKING:
    from torch import Tensor

    from primdiffusion.capture.reader import Captures
    from primdiffusion.human import Human
    from primdiffusion.training.refine import RefineStep

ENCODER, BODY = "encoder", "body"
"""Words for `start`."""
ENCODER_VIEWS = 8
"""Pictures that an encoder is given to start from."""


@dataclasses.dataclass(frozen=True)
class RefineCommand:
    """Optimise one captured person: human.npz for Blender, person.human.safetensors to keep, and pictures.

    Captures are those of `primdiffusion captures`, of Blender's Render Captures, or a dataset in the released code's
    layout, in several poses from many sides: with few views the person fits those and gets worse from elsewhere. Some
    cameras are held out and tell how good the result is.
    """

    capture: Path
    """Folder of a dataset of captures, or one subject's own folder in it."""
    out: Path
    """Folder to write to."""
    subject: str | None = None
    """Whom; not needed where there is only one."""
    start: str = BODY
    """Whom to begin with: body (bare and grey), encoder (what it makes of the first frame), or a file: a
    .human.safetensors, or a .glb of primdiffusion people."""
    checkpoint: Path | None = None
    """Trained encoder (.safetensors) for --start encoder; without it the one that comes with the package."""
    steps: int = 300
    """Steps of two pictures each."""
    size: int = 256
    """Pixels a side, at most, of the captures as they are used, and of the pictures that are written."""
    hold_out_cameras: int = 3
    """Cameras, evenly chosen, that are only looked at to judge the result; 0: none."""
    minutes: float = 5.0
    """The steps end where they take longer."""
    seed: int = 0
    """Of the order of views; the same gives the same person, unless time runs out."""

    def run(self) -> None:
        """Refines, and prints the folder and the PSNR before and after.

        Raises:
            ValueError, FileNotFoundError: captures, start or settings are missing, damaged or do not fit; OSError.
        """
        # torch is loaded late
        from primdiffusion.capture.conditioning import choose_subject, conditioning_views, default_betas
        from primdiffusion.commands.output import write_human
        from primdiffusion.machine import best_device
        from primdiffusion.staging import staged
        from primdiffusion.training.refine import RefineSettings, refine
        from primdiffusion.training.refine_views import view_psnr

        if self.size < 1:
            raise ValueError(f"pictures of {self.size} pixels a side: choose 1 or more")
        settings = RefineSettings(self.steps, seconds=60 * self.minutes, seed=self.seed)
        with staged(self.out) as folder:
            captures, name = choose_subject(self.capture, self.subject)
            person = captures.subject(name)
            betas = default_betas(person)
            held, given = dealt_cameras(len(person.views), self.hold_out_cameras)
            frames = range(person.frames)
            views = [conditioning_views(captures, name, frame, given, self.size) for frame in frames]
            judged = [conditioning_views(captures, name, frame, held, self.size) for frame in frames if held]
            human = self._start(captures, name, betas, given).to(best_device())
            with tqdm(total=self.steps, desc=name, unit="step", disable=None) as bar:

                def on_step(step: RefineStep) -> None:
                    bar.update()

                refined = refine(human, views, settings, on_step)
            write_human(folder, refined.human, self.size)
        seconds = f"{refined.steps} steps, {refined.seconds:.1f} s"
        print(f"{self.out}  {name}, {person.frames} frames, {len(given)} cameras, {seconds}")
        print(f"given views     {refined.psnr_before:.2f} -> {refined.psnr_after:.2f} dB")
        if held:
            before, after = (float(view_psnr(one, judged).mean()) for one in (human, refined.human))
            print(f"held-out views  {before:.2f} -> {after:.2f} dB (cameras {', '.join(map(str, held))})")
            if after < before:
                print(
                    "primdiffusion: warning: on held-out cameras the start was better: give more views", file=sys.stderr
                )
        if refined.steps < self.steps:
            print(f"primdiffusion: warning: {self.minutes:g} minutes were over after {seconds}", file=sys.stderr)

    def _start(self, captures: Captures, name: str, betas: Tensor, given: Sequence[int]) -> Human:
        """The person to begin with, on the captured body, whoever's they were."""
        # torch is loaded late
        from primdiffusion.human_file import load_human
        from primdiffusion.training.refine_views import bare_body, meshed_person

        if self.start == BODY:
            human = bare_body(betas)
        elif self.start == ENCODER:
            human = self._encoded(captures, name, betas, given)
        elif self.start.endswith(".glb"):
            human = meshed_person(self.start)
        else:
            human = load_human(self.start)
        if human.body_setup is not None:
            raise ValueError(
                f"{self.start} uses the body {human.body_setup.files.smpl.path}, but captures are fitted to the "
                "default body: start from a human on the default body, or from the encoder"
            )
        return dataclasses.replace(human, betas=betas, provenance={**human.provenance, "refined_from": name})

    def _encoded(self, captures: Captures, name: str, betas: Tensor, given: Sequence[int]) -> Human:
        # torch is loaded late
        from primdiffusion.capture.conditioning import CapturedPerson, conditioning_views
        from primdiffusion.encoder.model import load_encoder
        from primdiffusion.machine import best_device
        from primdiffusion.reconstruction import reconstruct

        cameras = tuple(given[:: math.ceil(len(given) / ENCODER_VIEWS)])
        views = conditioning_views(captures, name, 0, cameras)
        model = load_encoder(self.checkpoint, best_device())
        return reconstruct(model, CapturedPerson(name, 0, cameras, views, betas, ()))


def dealt_cameras(count: int, held: int) -> tuple[list[int], list[int]]:
    """Numbers of the cameras that are held out, evenly chosen of `count`, and of those that are given.

    Raises ValueError where none would be left to give.
    """
    if not 0 <= held < count:
        raise ValueError(f"{held} of {count} cameras cannot be held out: choose 0 to {count - 1}")
    out = [int((place + 0.5) * count / held) for place in range(held)]
    return out, [camera for camera in range(count) if camera not in out]


def run(arguments: Sequence[str]) -> None:
    """One command line, errors as exceptions."""
    tyro.cli(RefineCommand, args=arguments, prog="primdiffusion refine").run()
