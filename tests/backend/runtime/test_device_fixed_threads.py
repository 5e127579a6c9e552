"""The same seed gives the same bytes on any number of threads."""

import dataclasses

import pytest
import torch
from primdiffusion.diffusion.checkpoint import default_checkpoint, load_checkpoint, save_checkpoint
from primdiffusion.diffusion.codec import WholeSlab
from primdiffusion.diffusion.denoiser import LocalUNetConfig
from primdiffusion.diffusion.model import sample
from primdiffusion.runtime.device import GRID_THREADS, SLAB_THREADS, each_with_fixed_threads, fixed_threads
from support.errors import refused
from thread_bytes import by_threads
from tiny_model import tiny_model


@pytest.fixture(scope="module")
def model():
    """Its network has the operations whose results depend on the number of threads, and adds to every guess."""
    model = tiny_model(LocalUNetConfig(widths=(64, 128)))
    generator = torch.Generator().manual_seed(0)
    for parameter in model.denoiser.parameters():
        parameter.data.copy_(0.05 * torch.randn(parameter.shape, generator=generator))
    return model


def test_files_are_the_same_on_one_two_and_three_threads(model, tmp_path):
    checkpoint = tmp_path / "small.safetensors"
    save_checkpoint(checkpoint, model, "linear")
    one, two, three = by_threads(checkpoint, tmp_path, 6)
    assert one == two == three


@pytest.mark.slow
def test_files_of_the_default_checkpoint_are_the_same_on_one_two_and_three_threads(tmp_path):
    load_checkpoint(None)
    one, two, three = by_threads(default_checkpoint(), tmp_path, 30)
    assert one == two == three


def test_without_fixed_threads_the_network_of_these_tests_differs(model):
    x, results = torch.randn(1, 4, 32, 32), []
    for threads in (1, 2):
        with fixed_threads(threads):
            results.append(model.denoise(x, 500))
    assert not torch.equal(*results)


def test_the_caller_keeps_its_threads_between_steps_and_after_errors(model):
    with fixed_threads(2):
        for _ in sample(model, [1], 3):
            assert torch.get_num_threads() == 2
        assert torch.get_num_threads() == 2

        def fail():
            assert torch.get_num_threads() == 5
            yield 1
            raise ValueError("a failed step")

        items = each_with_fixed_threads(fail(), 5)
        assert next(items) == 1
        with refused(ValueError, "failed"):
            next(items)
        assert torch.get_num_threads() == 2


def test_networks_over_the_slab_get_more_threads(model):
    assert model.threads == GRID_THREADS
    assert dataclasses.replace(model, codec=WholeSlab()).threads == SLAB_THREADS
