"""Muon for the hidden layers of a network and AdamW for its other parameters, as one optimiser.

Muon (Jordan et al. 2024) makes the update of a matrix orthogonal, so all directions in it are learned equally fast; an
update of AdamW is dominated by a few. A convolution's kernel counts as a matrix with a row for each output channel. The
learning rate is scaled to AdamW's root mean square update (Liu et al. 2025).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

BETAS = (0.9, 0.99)
"""Decay of AdamW's two moments."""
ENDS = ("inner", "outer", "asked")
"""Layers that meet data rather than features, by name in the network of the default preset; left to AdamW."""
FACTOR = 3.0
"""Muon's learning rate over AdamW's."""


class MuonAdamW(torch.optim.Optimizer):
    """Optimiser of a network of the default preset; the state of a parameter is that of Muon or of AdamW."""

    def __init__(self, network: nn.Module, learning_rate: float, weight_decay: float) -> None:
        hidden = {
            module.weight
            for name, module in network.named_modules()
            if isinstance(module, nn.Linear | nn.Conv2d) and name.split(".")[0] not in ENDS
        }
        own = [parameter for parameter in network.parameters() if parameter in hidden]
        others = [parameter for parameter in network.parameters() if parameter not in hidden]
        self._muon = torch.optim.Muon(
            [_matrix(parameter.detach()) for parameter in own],
            lr=learning_rate, weight_decay=weight_decay, adjust_lr_fn="match_rms_adamw",
        )  # fmt: skip
        self._adamw = torch.optim.AdamW(others, lr=learning_rate, weight_decay=weight_decay, betas=BETAS)
        super().__init__([{"params": own, "factor": FACTOR}, {"params": others, "factor": 1.0}], {"lr": learning_rate})

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:
        """Update all parameters by their gradients; there is no `closure`."""
        for optimiser, group in zip((self._muon, self._adamw), self.param_groups, strict=True):
            optimiser.param_groups[0]["lr"] = group["lr"]
        for matrix, parameter in self._pairs():
            assert parameter.grad is not None
            matrix.data, matrix.grad = _matrix(parameter.detach()), _matrix(parameter.grad)
        self._muon.step()
        self._adamw.step()
        for matrix, parameter in self._pairs():
            self.state[parameter] = self._muon.state[matrix]
        for parameter in self._adamw.param_groups[0]["params"]:
            self.state[parameter] = self._adamw.state[parameter]

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore a state of `state_dict`."""
        super().load_state_dict(state_dict)
        for matrix, parameter in self._pairs():
            if parameter in self.state:
                self._muon.state[matrix] = self.state[parameter]
        for parameter in self._adamw.param_groups[0]["params"]:
            if parameter in self.state:
                self._adamw.state[parameter] = self.state[parameter]

    def _pairs(self) -> list[tuple[Tensor, Tensor]]:
        """The hidden layers' weights as matrices, which share their memory, each with its parameter."""
        return list(zip(self._muon.param_groups[0]["params"], self.param_groups[0]["params"], strict=True))


def _matrix(kernel: Tensor) -> Tensor:
    """Rows of output channels of a layer's weight or its gradient; shares its memory in either memory format."""
    if kernel.ndim == 4 and not kernel.is_contiguous():
        kernel = kernel.permute(0, 2, 3, 1)
    return kernel.flatten(1)
