"""Muon for the hidden layers of a network and AdamW for its other parameters, as one optimiser.

Muon (Jordan et al. 2024) makes the update of a matrix orthogonal, so all directions in it are learned equally fast; an
update of AdamW is dominated by a few. A convolution's kernel counts as a matrix with a row for each output channel. The
learning rate is scaled to AdamW's root mean square update (Liu et al. 2025).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from primdiffusion.render.cuda.graph import Recorded

ADAM_BETAS = (0.9, 0.99)
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
        # The learning rate scales changes afterwards: in a recording it would be a constant.
        self._muon = torch.optim.Muon(
            [torch.zeros_like(_matrix(parameter.detach())) for parameter in own],
            lr=1.0, weight_decay=0.0, adjust_lr_fn="match_rms_adamw",
        )  # fmt: skip
        self._recorded, self._weight_decay = Recorded(self._changes), weight_decay
        self._adamw = torch.optim.AdamW(others, lr=learning_rate, weight_decay=weight_decay, betas=ADAM_BETAS)
        super().__init__([{"params": own, "factor": FACTOR}, {"params": others, "factor": 1.0}], {"lr": learning_rate})

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:
        """Update all parameters by their gradients; there is no `closure`."""
        own, others = self.param_groups
        self._adamw.param_groups[0]["lr"] = others["lr"]
        self._adamw.step()
        if own["params"]:
            changes = self._recorded(*(_matrix(parameter.grad) for parameter in own["params"]))
            matrices = [_matrix(parameter) for parameter in own["params"]]
            torch._foreach_mul_(matrices, 1 - own["lr"] * self._weight_decay)  # pyright: ignore[reportPrivateImportUsage]
            torch._foreach_add_(matrices, changes, alpha=own["lr"])  # pyright: ignore[reportPrivateImportUsage]
        for change, parameter in self._pairs():
            self.state[parameter] = self._muon.state[change]
        for parameter in self._adamw.param_groups[0]["params"]:
            self.state[parameter] = self._adamw.state[parameter]

    def _changes(self, *gradients: Tensor) -> tuple[Tensor, ...]:
        """Changes of the matrices at a learning rate of 1; updates their momenta."""
        changes = self._muon.param_groups[0]["params"]
        for change, gradient in zip(changes, gradients, strict=True):
            change.zero_().grad = gradient
        self._muon.step()
        return tuple(changes)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore a state of `state_dict`."""
        super().load_state_dict(state_dict)
        self._recorded = Recorded(self._changes)
        for change, parameter in self._pairs():
            if parameter in self.state:
                self._muon.state[change] = self.state[parameter]
        for parameter in self._adamw.param_groups[0]["params"]:
            if parameter in self.state:
                self._adamw.state[parameter] = self.state[parameter]

    def _pairs(self) -> list[tuple[Tensor, Tensor]]:
        """Muon's changes, each with the parameter that it is for."""
        return list(zip(self._muon.param_groups[0]["params"], self.param_groups[0]["params"], strict=True))


def _matrix(kernel: Tensor) -> Tensor:
    """Rows of output channels of a layer's weight or its gradient; shares its memory in either memory format."""
    if kernel.ndim == 4 and not kernel.is_contiguous():
        kernel = kernel.permute(0, 2, 3, 1)
    return kernel.flatten(1)
