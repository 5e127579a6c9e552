"""Export a denoiser to ONNX: `primdiffusion export-onnx`."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import tyro

from primdiffusion.commands.request import parse


@dataclasses.dataclass(frozen=True)
class ExportOnnx:
    """Export the denoiser of a model to ONNX: x [b, C, H, W], t [b] and condition [b, a] to the clean guess x0."""

    checkpoint: tyro.conf.Positional[Path | None] = None
    """Trained model: a .safetensors file or a folder; the default is the one in the package."""
    out: Path = Path("denoiser.onnx")
    """Output .onnx."""

    def check(self) -> None:
        """Raise ValueError for another file name ending."""
        if self.out.suffix != ".onnx":
            raise ValueError(f"out is {self.out}: give a name that ends in .onnx")

    def export(self) -> None:
        """Export, and print the path. Raises as `load_pretrained` and `export_denoiser`."""
        # torch is loaded late
        from primdiffusion.diffusion.checkpoint import default_checkpoint
        from primdiffusion.diffusion.pretrained import load_pretrained
        from primdiffusion.export.denoiser_onnx import export_denoiser

        export_denoiser(self.out, load_pretrained(self.checkpoint or default_checkpoint()))
        print(self.out)


def run(arguments: Sequence[str]) -> None:
    """Run a command line; raises its errors."""
    parse(ExportOnnx, arguments, "export-onnx").export()
