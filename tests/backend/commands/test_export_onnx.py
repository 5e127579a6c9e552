"""The exported graph computes what the denoiser does."""

import json

import pytest
import torch
from primdiffusion import cli
from primdiffusion.diffusion.checkpoint import load_checkpoint
from support.errors import refused
from tiny_model import save_tiny_checkpoint


@pytest.mark.parametrize("weights", ["tiny", pytest.param("default", marks=pytest.mark.slow)])
def test_onnxruntime_agrees_with_torch_at_every_level_and_batch(tmp_path, capsys, weights):
    pytest.importorskip("onnxscript")
    runtime = pytest.importorskip("onnxruntime")
    given = [str(save_tiny_checkpoint(tmp_path / "tiny.safetensors"))] if weights == "tiny" else []
    model = load_checkpoint(*given)
    out = tmp_path / "denoiser.onnx"
    cli.run(["export-onnx", *given, "--out", str(out)])
    assert capsys.readouterr().out.splitlines()[-1] == str(out)
    session = runtime.InferenceSession(out, providers=["CPUExecutionProvider"])
    attributes = {"outfit": "suit"} if weights == "tiny" else {"sex": "female"}
    for condition in (torch.zeros(1, model.vocabulary.width), model.condition(attributes)):
        for levels in ([0], [20, 500, 999]):
            t = torch.tensor(levels)
            x = torch.randn(len(t), *model.codec.shape, generator=torch.Generator().manual_seed(1))
            asked = condition.reshape(1, -1).expand(len(t), -1).contiguous()
            with torch.inference_mode():
                expected = model.denoiser(x, t, asked if asked.any() else None)
            (x0,) = session.run(None, {"x": x.numpy(), "t": t.numpy(), "condition": asked.numpy()})
            assert (torch.from_numpy(x0) - expected).abs().max() < 1e-4
    about = session.get_modelmeta().custom_metadata_map
    assert json.loads(about["alpha_bar"]) == model.schedule.alpha_bar.tolist()


def test_another_ending_is_refused(tmp_path):
    with refused(ValueError, ".onnx"):
        cli.run(["export-onnx", "--out", str(tmp_path / "a.pt")])
