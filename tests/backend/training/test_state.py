"""The state of a training run: what is saved, restored and rejected."""

import pytest
import torch
from primdiffusion.files import tensor_file
from primdiffusion.training.config import NetworkTraining
from primdiffusion.training.state import TrainingState, accelerator_of, learning_rate_factor
from support.errors import refused


def state_of_a_line():
    torch.manual_seed(3)
    network = torch.nn.Sequential(torch.nn.Linear(3, 8), torch.nn.Tanh(), torch.nn.Linear(8, 1))
    return TrainingState(network, NetworkTraining(steps=50, batch=4), accelerator_of())


def advance(state, steps):
    for _ in range(steps):
        x = torch.randn(4, 3, generator=torch.Generator().manual_seed(state.step))
        state.update((state.network(x) - x.sum(1, keepdim=True)).square().mean())


def test_the_average_lags_behind_the_weights():
    state = state_of_a_line()
    start = [p.clone() for p in state.network.parameters()]
    advance(state, 15)
    moved = sum((p - q).abs().sum() for p, q in zip(state.network.parameters(), start, strict=True))
    lagged = sum((p - q).abs().sum() for p, q in zip(state.average.parameters(), start, strict=True))
    assert 0 < lagged < moved


def test_a_state_of_another_network_is_rejected(tmp_path):
    state = state_of_a_line()
    other = TrainingState(torch.nn.Linear(2, 2), NetworkTraining(steps=1, batch=1), accelerator_of())
    state.save(tmp_path / "state")
    with refused(ValueError, "does not fit"):
        other.load(tmp_path / "state")


@pytest.mark.parametrize("number", [float("nan"), 1e30])
def test_impossible_numbers_in_a_state_are_rejected(tmp_path, number):
    path = tmp_path / "state"
    state_of_a_line().save(path)
    tensors, place = tensor_file.read(path)
    path.write_bytes(tensor_file.save({**tensors, "average.bias": torch.tensor([number])}, place))
    with refused(ValueError, "average.bias", "NaN"):
        state_of_a_line().load(path)


def test_a_gradient_that_is_not_finite_stops_the_run():
    state = state_of_a_line()
    with refused(ValueError, "step 0"):
        state.update(state.network(torch.full((1, 3), float("nan"))).sum())


def test_learning_rate_warms_up_and_falls_to_a_tenth():
    assert learning_rate_factor(0, 1000) == pytest.approx(0.01)
    assert learning_rate_factor(99, 10**9) == pytest.approx(1.0)
    assert learning_rate_factor(1000, 1000) == pytest.approx(0.1)
