"""What a run of stage 1 needs to go on exactly where it stopped, on any number of processes."""

from __future__ import annotations

from accelerate import Accelerator

from primdiffusion.encoder.blocks import UntiedConv
from primdiffusion.encoder.network import Encoder
from primdiffusion.training.accelerated import AcceleratedState
from primdiffusion.training.fit_config import FitConfig


class FitState(AcceleratedState):
    """`AcceleratedState` of an encoder; `place["position"]` is the place in the data, as JSON."""

    def __init__(self, encoder: Encoder, config: FitConfig, accelerator: Accelerator) -> None:
        self.place_rate = config.place_rate
        super().__init__(encoder, config, config.seed, accelerator)

    def _groups(self) -> list[dict[str, object]]:
        """A place's own bias is met once a picture, a weight at every place: at one rate the weights run away."""
        biases = [m.bias for m in self.network.modules() if isinstance(m, UntiedConv)]
        known = {id(bias) for bias in biases}
        others = [parameter for parameter in self.network.parameters() if id(parameter) not in known]
        return [{"params": others, "factor": 1.0}, {"params": biases, "factor": self.place_rate}]

    @property
    def encoder(self) -> Encoder:
        """With averaged weights: what is measured and kept."""
        assert isinstance(self.average, Encoder)
        return self.average
