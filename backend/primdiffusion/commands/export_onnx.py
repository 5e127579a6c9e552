"""Export a denoiser as an ONNX graph, for runtimes without torch: `primdiffusion export-onnx`."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from primdiffusion.commands.options import ExportOnnxCommand
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.diffusion.schedule import CHAINS
from primdiffusion.failures import optional_package
from primdiffusion.formats.whole_files import written_whole

EXTRA = "onnx"
"""Of pyproject.toml, with the packages that export needs."""


def run(command: ExportOnnxCommand) -> None:
    """Export, and print the path. Raises as `load_checkpoint` and `export_denoiser`."""
    export_denoiser(command.out, load_checkpoint(command.checkpoint))
    print(command.out)


class _Conditioned(nn.Module):
    """The denoiser with a condition that is always given: zeros are unconditional."""

    def __init__(self, denoiser: nn.Module) -> None:
        super().__init__()
        self.denoiser = denoiser
        self.eval()

    def forward(self, x: Float[Tensor, "b c h w"], t: Int[Tensor, "b"], condition: Float[Tensor, "b a"]) -> Tensor:
        return self.denoiser(x, t, condition)


def export_denoiser(path: Path, model: DiffusionModel) -> None:
    """Write the x0 guess of `model.denoiser` as an ONNX graph in float32, atomically.

    Inputs x [b, C, H, W] and t [b] (int64), for a model with attributes also condition [b, a] (zeros: unconditional);
    output x0 [b, C, H, W]; b is free. The file's metadata has alpha_bar (JSON, T numbers), the chain and the
    vocabulary. Raises MissingPackageError without the packages of the extra `onnx`, and OSError.
    """
    onnx = optional_package("onnx", EXTRA)
    optional_package("onnxscript", EXTRA)
    denoiser, width = model.denoiser.eval(), model.vocabulary.width
    example = [torch.zeros(2, *model.codec.shape, device=model.device), torch.tensor([0, 500], device=model.device)]
    names, network = ["x", "t"], denoiser
    if width:
        example.append(torch.zeros(2, width, device=model.device))
        names, network = [*names, "condition"], _Conditioned(denoiser)
    batch = torch.export.Dim("batch", min=1)
    program = torch.onnx.export(
        network,
        tuple(example),
        input_names=names,
        output_names=["x0"],
        dynamic_shapes=tuple({0: batch} for _ in example),
        dynamo=True,
        verbose=False,
    )
    assert program is not None, "the exporter returns a program where no file is named"
    proto = program.model_proto
    chain = next(name for name, steps in CHAINS.items() if steps is model.chain)
    about = {
        "alpha_bar": json.dumps(model.schedule.alpha_bar.tolist()),
        "chain": chain,
        "vocabulary": json.dumps(model.vocabulary.to_json()),
    }
    onnx.helper.set_model_props(proto, about)
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path) as unfinished:
        unfinished.write_bytes(proto.SerializeToString())
