"""Reconstruct a human from captures, and refine it: `reconstruct` and `refine`, `reconstruct` also of JSON-RPC."""

from __future__ import annotations

import dataclasses
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro
from tqdm import tqdm

from primdiffusion.commands.request import OutDir, ReportProgress, check_size, parse, progress_bar
from primdiffusion.formats import requests
from primdiffusion.formats.whole_files import staged
from primdiffusion.machine import best_device, peak_memory_gb

if TYPE_CHECKING:
    from torch import Tensor

    from primdiffusion.capture.reader import Captures
    from primdiffusion.commands.session import Session
    from primdiffusion.human import Human
    from primdiffusion.training.refine import RefineStep

STEPS = 4
"""Load, read, encode, write."""
ENCODER, BODY = "encoder", "body"
"""Values of `start`."""
ENCODER_VIEWS = 8
"""Images to encode for `start`."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReconstructRequest:
    """Reconstruct a human from captures: human.npz for Blender, person.human.safetensors, and previews.

    The encoder takes several views of one frame and needs no training per subject. Captures are those of
    `primdiffusion captures`, of Blender's Render Captures, or a dataset in the released code's layout.
    """

    capture: Path
    """Folder of a capture dataset, or of one subject in it."""
    out_dir: OutDir
    """Output folder; created if missing."""
    subject: str | None = None
    """Name of the subject; not needed if there is only one."""
    frame: int = 0
    """Frame to encode; 0 is near the T pose, which has the least occlusion."""
    views: int = requests.CAPTURE_VIEWS
    """Number of cameras, spread around the subject; all if there are fewer."""
    checkpoint: Path | None = None
    """Trained encoder (.safetensors); the default is the one in the package."""
    size: int = requests.PICTURE_SIZE
    """Width and height of the previews, pixels."""

    def check(self) -> None:
        """See `RequestRecord`."""
        if self.frame < 0:
            raise ValueError(f"frame is {self.frame}: frames are numbered from 0")
        if self.views < 1:
            raise ValueError(f"{self.views} views were requested: the encoder needs one or more")
        check_size(self.size)

    def run(self, session: Session, report: ReportProgress) -> dict[str, Any]:
        """Write the human, all files or none; return their paths, the views used and the time taken.

        Raises OSError first of all if the folder cannot be written to; raises as captured_person and load_encoder.
        """
        # torch is loaded late
        from primdiffusion.capture.conditioning import captured_person
        from primdiffusion.commands.output import FILES, write_human
        from primdiffusion.reconstruction import reconstruct

        began = time.perf_counter()
        with staged(self.out_dir) as folder:
            report("load", 0, STEPS, None)
            model = session.encoder(self.checkpoint)
            report("read", 1, STEPS, None)
            person = captured_person(self.capture, self.subject, self.frame, self.views, model.body)
            report("encode", 2, STEPS, None)
            loaded = time.perf_counter()
            human = reconstruct(model, person)
            encoded = time.perf_counter()
            report("write", 3, STEPS, None)
            write_human(folder, human, self.size)
            report("write", STEPS, STEPS, 0.0)  # the last chance to cancel
        return {
            **FILES.in_folder(self.out_dir),
            "subject": person.subject,
            "frame": person.frame,
            "views": list(person.cameras),
            "warnings": list(person.warnings),
            "seconds": round(time.perf_counter() - began, 3),
            "seconds_encoding": round(encoded - loaded, 3),
            "peak_gb": round(peak_memory_gb(), 3),
        }


def run(arguments: Sequence[str]) -> None:
    """Run a command line and print the output folder; raises its errors."""
    request = parse(ReconstructRequest, arguments, "reconstruct")
    from primdiffusion.commands.session import Session  # loads torch, which --help does not need

    with progress_bar() as report:
        result = request.run(Session(), report)
    for warning in result["warnings"]:
        print(f"primdiffusion: warning: {warning}", file=sys.stderr)
    seconds = f"{result['seconds']:.1f} s, of which the encoder {result['seconds_encoding']:.1f} s"
    print(f"{request.out_dir}  {result['subject']}, frame {result['frame']}, {len(result['views'])} views, {seconds}")


@dataclasses.dataclass(frozen=True)
class RefineCommand:
    """Optimise a human to match captures: human.npz for Blender, person.human.safetensors, and previews.

    Captures are those of `primdiffusion captures`, of Blender's Render Captures, or a dataset in the released code's
    layout, in several poses and from many sides: with few views the result overfits to them. Some cameras are held out
    to evaluate the result.
    """

    capture: Path
    """Folder of a capture dataset, or of one subject in it."""
    out: Path
    """Output folder."""
    subject: str | None = None
    """Name of the subject; not needed if there is only one."""
    start: str = BODY
    """Initial human: body (the bare body in grey), encoder (reconstructed from the first frame), or a file: a
    .human.safetensors, or a .glb of primdiffusion people."""
    checkpoint: Path | None = None
    """Trained encoder (.safetensors) for --start encoder; the default is the one in the package."""
    steps: int = 300
    """Optimiser steps, of two images each."""
    size: int = 256
    """Largest side of the images used, and width and height of the previews, pixels."""
    hold_out_cameras: int = 3
    """Number of cameras, evenly spaced, held out for evaluation."""
    minutes: float = 5.0
    """Time limit of the optimisation."""
    seed: int = 0
    """Seed of the order of views; the same seed gives the same human unless time runs out."""

    def run(self) -> None:
        """Refine; print the folder and the PSNR before and after.

        Raises:
            ValueError, FileNotFoundError: captures, start or settings are missing, damaged or do not match; OSError.
        """
        # torch is loaded late
        from primdiffusion.capture.conditioning import choose_subject, conditioning_views, default_betas
        from primdiffusion.commands.output import write_human
        from primdiffusion.training.refine import RefineSettings, refine
        from primdiffusion.training.refine_views import view_psnr

        if self.size < 1:
            raise ValueError(f"size is {self.size} pixels: choose 1 or more")
        settings = RefineSettings(self.steps, seconds=60 * self.minutes, seed=self.seed)
        with staged(self.out) as folder:
            captures, name = choose_subject(self.capture, self.subject)
            person = captures.subject(name)
            betas = default_betas(person)
            held, given = split_cameras(len(person.views), self.hold_out_cameras)
            frames = range(person.frames)
            views = [conditioning_views(captures, name, frame, given, self.size) for frame in frames]
            held_out = [conditioning_views(captures, name, frame, held, self.size) for frame in frames if held]
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
            before, after = (float(view_psnr(one, held_out).mean()) for one in (human, refined.human))
            print(f"held-out views  {before:.2f} -> {after:.2f} dB (cameras {', '.join(map(str, held))})")
            if after < before:
                print("primdiffusion: warning: the held-out PSNR decreased: use more views", file=sys.stderr)
        if refined.steps < self.steps:
            print(
                f"primdiffusion: warning: the time limit of {self.minutes:g} minutes was reached after {seconds}",
                file=sys.stderr,
            )

    def _start(self, captures: Captures, name: str, betas: Tensor, given: Sequence[int]) -> Human:
        """Return the initial human with the subject's betas."""
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
        from primdiffusion.reconstruction import reconstruct

        cameras = tuple(given[:: math.ceil(len(given) / ENCODER_VIEWS)])
        views = conditioning_views(captures, name, 0, cameras)
        model = load_encoder(self.checkpoint, best_device())
        return reconstruct(model, CapturedPerson(name, 0, cameras, views, betas, ()))


def split_cameras(count: int, held: int) -> tuple[list[int], list[int]]:
    """Split `count` cameras into `held` evenly spaced ones to hold out and the others; return both as indices.

    Raises ValueError if no other would be left.
    """
    if not 0 <= held < count:
        raise ValueError(f"{held} of {count} cameras cannot be held out: choose 0 to {count - 1}")
    out = [int((place + 0.5) * count / held) for place in range(held)]
    return out, [camera for camera in range(count) if camera not in out]


def run_refine(arguments: Sequence[str]) -> None:
    """Run a command line of `refine`; raises its errors."""
    tyro.cli(RefineCommand, args=arguments, prog="primdiffusion refine").run()
