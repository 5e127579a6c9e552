"""Graphs on processors: a repetition runs the function again, as it was recorded."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any
from unittest import mock

import pytest
import torch
from primdiffusion.render.cuda import graph as cuda_graph
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

try:
    from primdiffusion.render.cuda import scene as cuda_scene
except ImportError:  # without Triton, which only the marcher needs
    cuda_scene = SimpleNamespace(_plans={})


def on_processors(patch: pytest.MonkeyPatch) -> list["Graph"]:
    """Record on processors from now on; returns the graphs, as they are recorded."""
    graphs: list[Graph] = []

    def record(function: Callable[[], Any]) -> tuple["Graph", Any]:
        graphs.append(Graph(function))
        return graphs[-1], graphs[-1].result

    patch.setattr(cuda_graph, "usable", lambda device: cuda_graph.ENABLED)
    patch.setattr(cuda_graph, "record", record)
    patch.setattr(torch.cuda, "current_stream", lambda device=None: SimpleNamespace(cuda_stream=0))
    return graphs


class Graph:
    """Like CUDA's: recording changes no tensor and draws no number; launch parameters stay those of the recording."""

    def __init__(self, function: Callable[[], Any]) -> None:
        self._function, self._recording, self._plans = function, cuda_graph.recording(), dict(cuda_scene._plans)
        self.replays = 0
        with torch.random.fork_rng([]), _Undone():
            self.result = self._run()
        for tensor in self._tensors(self.result):
            tensor.fill_(torch.nan if tensor.is_floating_point() else -1)

    def replay(self) -> None:
        self.replays += 1
        for old, new in zip(self._tensors(self.result), self._tensors(self._run()), strict=True):
            old.copy_(new)

    def _run(self) -> Any:
        token = cuda_graph._expected.set([]) if self._recording else None
        try:
            with mock.patch.object(cuda_scene, "_plans", dict(self._plans)):
                return self._function()
        finally:
            if token is not None:
                cuda_graph._expected.reset(token)

    @staticmethod
    def _tensors(result: Any) -> list[Tensor]:
        return [leaf.detach() for leaf in tree_leaves(result) if isinstance(leaf, Tensor)]


class _Undone(TorchDispatchMode):
    """Gives tensors back, at the end, the values that they had."""

    def __enter__(self) -> "_Undone":
        self._before: dict[int, tuple[Tensor, Tensor]] = {}
        return super().__enter__()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        for argument, value in zip(func._schema.arguments, args, strict=False):
            written = argument.alias_info is not None and argument.alias_info.is_write
            if written and not func.__name__.startswith("set_"):  # by Triton's interpreter, of tensors of its own
                for tensor in tree_leaves(value):
                    self._before.setdefault(id(tensor), (tensor, tensor.clone()))
        return func(*args, **(kwargs or {}))

    def __exit__(self, *exception):
        super().__exit__(*exception)
        with torch.no_grad():
            for tensor, value in reversed(self._before.values()):
                tensor.detach().copy_(value)
