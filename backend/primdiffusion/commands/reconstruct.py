"""A person from captures: `primdiffusion reconstruct`, and `reconstruct` of JSON-RPC."""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from primdiffusion.commands.request import OutDir, ReportProgress, check_size, parse, progress_bar
from primdiffusion.formats import requests

if TYPE_CHECKING:
    from primdiffusion.commands.session import Session

STEPS = 4
"""Read, load, encode, write."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReconstructRequest:
    """Make a person from captures: human.npz for Blender, person.human.safetensors to keep, and pictures.

    The encoder looks at some views of one frame and needs no training for the person. Captures are those of
    `primdiffusion captures`, of Blender's Render Captures, or a dataset in the released code's layout.
    """

    capture: Path
    """Folder of a dataset of captures, or one subject's own folder in it."""
    out_dir: OutDir
    """Folder to write to; made if missing."""
    subject: str | None = None
    """Whom; not needed where there is only one."""
    frame: int = 0
    """Which pose to look at; 0 is near the T pose, where most of a person is seen."""
    views: int = requests.CAPTURE_VIEWS
    """How many cameras, spread around the person; all where there are fewer."""
    checkpoint: Path | None = None
    """Trained encoder (.safetensors); without it the one that comes with the package."""
    size: int = requests.PICTURE_SIZE
    """Pixels a side of the pictures that are written."""

    def check(self) -> None:
        """See `Request`."""
        if self.frame < 0:
            raise ValueError(f"frame {self.frame}: they are counted from 0")
        if self.views < 1:
            raise ValueError(f"{self.views} views were asked for: the encoder needs one or more")
        check_size(self.size)

    def run(self, session: Session, report: ReportProgress) -> dict[str, Any]:
        """Writes the person, all files or none; returns their paths, what was seen and what it took.

        Raises OSError before any work if the folder cannot be written to; what captured_person and load_encoder raise.
        """
        # torch is loaded late
        from primdiffusion.capture.conditioning import captured_person
        from primdiffusion.commands.output import FILES, write_human
        from primdiffusion.machine import peak_memory_gb
        from primdiffusion.reconstruction import reconstruct
        from primdiffusion.staging import staged

        began = time.perf_counter()
        with staged(self.out_dir) as folder:
            report("read", 0, STEPS, None)
            person = captured_person(self.capture, self.subject, self.frame, self.views)
            report("load", 1, STEPS, None)
            model = session.encoder(self.checkpoint)
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
    """One command line, errors as exceptions; prints the folder."""
    request = parse(ReconstructRequest, arguments, "reconstruct")
    from primdiffusion.commands.session import Session  # loads torch, which --help does not need

    with progress_bar() as report:
        result = request.run(Session(), report)
    for warning in result["warnings"]:
        print(f"primdiffusion: warning: {warning}", file=sys.stderr)
    seconds = f"{result['seconds']:.1f} s, of which the encoder {result['seconds_encoding']:.1f} s"
    print(f"{request.out_dir}  {result['subject']}, frame {result['frame']}, {len(result['views'])} views, {seconds}")
