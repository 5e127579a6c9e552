"""Export a denoiser to ONNX: `primdiffusion export-onnx`."""

from __future__ import annotations

from primdiffusion.commands.options import ExportOnnxCommand
from primdiffusion.diffusion.checkpoint import default_checkpoint
from primdiffusion.diffusion.pretrained import load_pretrained
from primdiffusion.export.denoiser_onnx import export_denoiser


def run(command: ExportOnnxCommand) -> None:
    """Export, and print the path. Raises as `load_pretrained` and `export_denoiser`."""
    export_denoiser(command.out, load_pretrained(command.checkpoint or default_checkpoint()))
    print(command.out)
