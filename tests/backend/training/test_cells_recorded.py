"""Steps of stage 2 as they are recorded on a CUDA device, here by graphs that run the functions again."""

import contextlib
import os

import pytest
import torch
from diffuse_runs import make_small, settings
from primdiffusion.diffusion.denoiser import PersonDenoiser
from primdiffusion.diffusion.gaussian import PersonComponents
from primdiffusion.render.cuda import graph as cuda_graph
from primdiffusion.training import diffusion_task
from primdiffusion.training.cells import CellTask
from primdiffusion.training.config import NetworkTraining
from primdiffusion.training.diffuse import MODEL, train
from primdiffusion.training.muon import MuonAdamW
from primdiffusion.training.run_folder import STATE
from support import graphs
from support.runs import same_tensors
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

STEPS = 4


@pytest.fixture(scope="module")
def trained(people, whole, tmp_path_factory):
    """Trains in a new folder and returns it."""

    def train_there():
        run = tmp_path_factory.mktemp("recorded") / "run"
        run.mkdir()
        os.link(whole / "prepared.safetensors", run / "prepared.safetensors")
        muon = NetworkTraining(steps=STEPS, batch=4, evaluate_every=2, optimiser="muon", weight_decay=0.1)
        train(settings(people, run, local=muon))
        return run

    with pytest.MonkeyPatch.context() as patch:
        make_small(patch)
        patch.setattr(diffusion_task, "has_bfloat16", lambda device: True)
        train_there.plain = train_there()
        yield train_there


def assert_same(run, plain):
    for name in (STATE, MODEL):
        assert same_tensors(run / name, plain / name), name


def test_recorded_steps_train_the_same_bits_as_steps_launched_one_by_one(trained, monkeypatch):
    found = graphs.on_processors(monkeypatch)
    assert_same(trained(), trained.plain)
    # loss and gradients, and Muon's changes; the first call of each is launched, as Triton compiles then
    assert [graph.replays for graph in found] == [STEPS - 1, STEPS - 1]


def test_what_cannot_be_recorded_is_launched_from_python_and_said_once(trained, monkeypatch, caplog):
    monkeypatch.setattr(cuda_graph, "usable", lambda device: True)

    def record(function):
        raise RuntimeError("operation not permitted when stream is capturing")

    monkeypatch.setattr(cuda_graph, "record", record)
    assert_same(trained(), trained.plain)
    assert caplog.text.count("cannot be recorded: operation not permitted") == 2


def test_several_processes_exchange_gradients_in_the_backward_pass_so_nothing_is_recorded(monkeypatch):
    found = graphs.on_processors(monkeypatch)
    monkeypatch.setattr(torch.distributed, "is_initialized", lambda: True)
    network = torch.nn.Linear(2, 1)
    loss = cuda_graph.RecordedLoss(lambda x: network(x).square().mean(), network)
    for _ in range(3):
        loss(torch.ones(4, 2)).backward()
    assert not found
    once = torch.autograd.grad(loss(torch.ones(4, 2)), network.bias)[0]
    torch.testing.assert_close(network.bias.grad, 3 * once)


class WithoutCopies(TorchDispatchMode):
    """Fails where a tensor moves to another device, as no recording may wait for that."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        found = func(*args, **(kwargs or {}))
        devices = {leaf.device.type for leaf in tree_leaves((args, found)) if isinstance(leaf, torch.Tensor)}
        assert len(devices) < 2, func
        return found


def test_what_is_recorded_neither_reads_from_the_device_nor_copies_to_it(prepared_once, monkeypatch):
    """On a device without data, where reading is an error."""
    config, prepared = prepared_once
    task = CellTask(config, prepared, torch.device("cpu"))
    batch = [tensor.to("meta") for tensor in task.objective.batch(torch.Generator().manual_seed(0))]
    monkeypatch.setattr(
        PersonDenoiser, "_precision", lambda *_: contextlib.nullcontext()
    )  # autocast knows no such device
    monkeypatch.setattr(
        PersonComponents, "_cells", task.denoiser.prior.part.bincount().tolist()
    )  # read by the first call
    for shape in ((1, 1), (1, 1, 1, 1)):
        task.denoiser.schedule.levels(batch[2], torch.empty(shape, device="meta"))
    network = task.denoiser.to("meta").requires_grad_(True).get_submodule("local")
    muon = MuonAdamW(network, 1e-3, 0.0)
    recorded = cuda_graph.RecordedLoss(task.objective.error, network)
    with WithoutCopies():
        _, *gradients = recorded._with_gradients(*batch)
        hidden = muon.param_groups[0]["params"]
        for parameter, gradient in zip(network.parameters(), gradients, strict=True):
            parameter.grad = gradient
        muon._changes(*(parameter.grad.flatten(1) for parameter in hidden))
