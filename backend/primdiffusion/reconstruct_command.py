"""The command `primdiffusion reconstruct`: pictures of a person in, the person out."""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import tyro


@dataclasses.dataclass(frozen=True)
class Reconstruct:
    """Make a person from captures: human.npz for Blender, person.human.safetensors to keep, and pictures.

    The encoder looks at some views of one frame and needs no training for the person. Captures are those of
    `primdiffusion captures`, of Blender's Render Captures, or a dataset in the released code's layout.
    """

    capture: Path
    """Folder of a dataset of captures, or one subject's own folder in it."""
    out: Path
    """Folder to write to."""
    subject: str | None = None
    """Whom; not needed where there is only one."""
    frame: int = 0
    """Which pose to look at; 0 is near the T pose, where most of a person is seen."""
    views: int = 8
    """How many cameras, spread around the person; all where there are fewer."""
    checkpoint: Path | None = None
    """Trained encoder (.safetensors); without it the one that comes with the package."""
    size: int = 512
    """Pixels a side of the pictures that are written."""

    def run(self) -> None:
        """Reconstructs, and prints the folder.

        Raises:
            ValueError, FileNotFoundError: captures or checkpoint are missing, damaged or do not fit; OSError.
        """
        from primdiffusion.capture.conditioning import captured_person
        from primdiffusion.encoder.checkpoint import load_encoder
        from primdiffusion.machine import best_device
        from primdiffusion.person_folder import write_person
        from primdiffusion.reconstruction import reconstruct
        from primdiffusion.staging import staged

        if self.size < 1:
            raise ValueError(f"pictures of {self.size} pixels a side: choose 1 or more")
        began = time.perf_counter()
        with staged(self.out) as folder:
            person = captured_person(self.capture, self.subject, self.frame, self.views)
            for warning in person.warnings:
                print(f"primdiffusion: warning: {warning}", file=sys.stderr)
            model = load_encoder(self.checkpoint, best_device())
            loaded = time.perf_counter()
            human = reconstruct(model, person)
            encoded = time.perf_counter()
            write_person(folder, human, self.size)
        seconds = f"{time.perf_counter() - began:.1f} s, of which the encoder {encoded - loaded:.1f} s"
        print(f"{self.out}  {person.subject}, frame {person.frame}, {len(person.cameras)} views, {seconds}")


def run(arguments: Sequence[str]) -> None:
    """One command line, errors as exceptions."""
    tyro.cli(Reconstruct, args=arguments, prog="primdiffusion reconstruct").run()
