"""Export a denoiser to ONNX: `primdiffusion export-onnx`."""

from __future__ import annotations

from primdiffusion.commands.options import ExportOnnxCommand
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.export.denoiser_onnx import export_denoiser


def run(command: ExportOnnxCommand) -> None:
    """Export, and print the path. Raises as `load_checkpoint` and `export_denoiser`."""
    export_denoiser(command.out, load_checkpoint(command.checkpoint))
    print(command.out)
