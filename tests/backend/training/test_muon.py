"""Muon for hidden layers beside AdamW for the others."""

import pytest
import torch
from primdiffusion.training import diffusion_task
from primdiffusion.training.config import NetworkTraining
from primdiffusion.training.diffusion_task import DiffusionTask
from primdiffusion.training.loop import begin_training
from primdiffusion.training.state import accelerator_of
from support.errors import refused
from torch import nn


class Net(nn.Module):
    """A convolution between two ends."""

    def __init__(self):
        super().__init__()
        self.inner, self.hidden, self.outer = nn.Conv2d(2, 6, 1), nn.Conv2d(6, 6, 3, padding=1), nn.Conv2d(6, 1, 1)

    def forward(self, x):
        return self.outer(torch.tanh(self.hidden(self.inner(x))))


class NetTask(DiffusionTask):
    """As much of a task as a state needs."""

    name = "net"

    def __init__(self, memory_format, **settings):
        torch.manual_seed(3)
        self.net, self.device = Net().to(memory_format=memory_format), torch.device("cpu")
        self.config = NetworkTraining(steps=50, batch=4, weight_decay=0.0, optimiser="muon", **settings)

    @property
    def settings(self):
        return self.config

    def network(self):
        return self.net

    def use_network(self, network):
        self.net = network

    def loss(self, step): ...

    def errors(self): ...

    def model(self): ...


@pytest.fixture(autouse=True)
def fast(monkeypatch):
    """A device that multiplies bfloat16 fast."""
    monkeypatch.setattr(diffusion_task, "has_bfloat16", lambda device: True)


def started(memory_format=torch.channels_last, **settings):
    return begin_training(NetTask(memory_format, **settings), accelerator_of())


def advance(state, steps):
    for _ in range(steps):
        x = torch.randn(4, 2, 5, 5, generator=torch.Generator().manual_seed(state.step))
        state.update((state.network(x) - x.sum(1, keepdim=True)).square().mean())


@pytest.mark.parametrize("memory_format", [torch.channels_last, torch.contiguous_format])
def test_the_first_update_of_a_hidden_layer_is_orthogonal_and_of_adamws_size(memory_format):
    state = started(memory_format, learning_rate=1e-2)
    before = state.network.hidden.weight.detach().clone()
    advance(state, 1)
    change = (state.network.hidden.weight.detach() - before).flatten(1) / 1e-4  # after a warm-up of one in 100 steps
    singular = torch.linalg.svdvals(change)
    assert singular.max() / singular.min() < 2.0  # Newton and Schulz come near 1, not to it
    assert change.square().mean().sqrt() == pytest.approx(3 * 0.2 * 54**0.5 / 54**0.5, rel=0.2)


def test_only_hidden_kernels_have_a_momentum():
    state = started()
    advance(state, 1)
    moments = {name: set(state.optimiser.state[parameter]) for name, parameter in state.network.named_parameters()}
    assert [name for name, held in moments.items() if held == {"momentum_buffer"}] == ["hidden.weight"]
    assert all({"exp_avg", "exp_avg_sq"} < held for name, held in moments.items() if name != "hidden.weight")


def test_the_loss_falls():
    state = started(learning_rate=5e-2)
    x = torch.randn(64, 2, 5, 5, generator=torch.Generator().manual_seed(1))

    def loss():
        with torch.no_grad():
            return (state.network(x) - x.sum(1, keepdim=True)).square().mean()

    first = loss()
    advance(state, 50)
    assert loss() < 0.5 * first


def test_a_saved_state_goes_on_bit_for_bit(tmp_path):
    whole, part = started(), started()
    advance(whole, 9)
    advance(part, 4)
    part.save(tmp_path / "state")
    resumed = started()
    resumed.load(tmp_path / "state")
    advance(resumed, 5)
    for a, b in zip(whole.network.parameters(), resumed.network.parameters(), strict=True):
        assert torch.equal(a, b)


def test_a_device_that_is_slow_in_bfloat16_takes_adamw(monkeypatch, tmp_path):
    state = started()
    state.save(tmp_path / "muon.safetensors")
    monkeypatch.setattr(diffusion_task, "has_bfloat16", lambda device: False)
    slow = started()
    advance(slow, 1)
    assert all("exp_avg" in slow.optimiser.state[parameter] for parameter in slow.network.parameters())
    slow.save(tmp_path / "adamw.safetensors")
    started().load(tmp_path / "adamw.safetensors")
    with refused(ValueError, "trained"):
        slow.load(tmp_path / "muon.safetensors")
