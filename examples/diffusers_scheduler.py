"""The schedules and samplers as a scheduler of the diffusers library, which needs that package.

scheduler = PrimDiffusionScheduler.of(model, "dpmpp_2m")
scheduler.set_timesteps(30)
for t in scheduler.timesteps:
    x = scheduler.step(model.denoise(x, int(t), condition, 2.0), t, x).prev_sample
"""

from __future__ import annotations

from typing import Literal

import torch
from diffusers.configuration_utils import ConfigMixin, register_to_config
from diffusers.schedulers.scheduling_ddim import DDIMSchedulerOutput
from diffusers.schedulers.scheduling_utils import SchedulerMixin
from jaxtyping import Float, Int
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.diffusion.samplers import SAMPLERS, Generators, ddim_step, ddpm_step, dpmpp_2m_step
from primdiffusion.diffusion.schedule import CHAINS, CLEAN, SCHEDULES, schedule_name
from torch import Tensor

PREDICTIONS = ("sample", "epsilon")


class PrimDiffusionScheduler(SchedulerMixin, ConfigMixin):
    """A schedule, timesteps and a sampler of this package behind the interface of diffusers' schedulers.

    `eta` is that of `ddim`; `prediction_type` says whether networks predict the clean sample, as ours do, or the noise.
    Raises ValueError for names that do not exist.
    """

    order = 1
    init_noise_sigma = 1.0
    _compatibles = []  # noqa: RUF012 - as diffusers declares it

    @register_to_config
    def __init__(
        self,
        schedule: str = "linear",
        chain: str = "trailing",
        sampler: str = "ddim",
        eta: float = 0.0,
        prediction_type: Literal["sample", "epsilon"] = "sample",
        num_train_timesteps: int = 1000,
    ) -> None:
        for name, given, known in (
            ("schedule", schedule, SCHEDULES),
            ("chain", chain, CHAINS),
            ("sampler", sampler, SAMPLERS),
            ("prediction_type", prediction_type, PREDICTIONS),
        ):
            if given not in known:
                raise ValueError(f"there is no {name} {given!r}; choose one of {', '.join(known)}")
        self.schedule = SCHEDULES[schedule](num_train_timesteps)
        self.chain, self.sampler, self.eta, self.prediction_type = CHAINS[chain], sampler, eta, prediction_type
        self.num_inference_steps: int | None = None
        self.timesteps: Int[Tensor, "n"] = torch.arange(num_train_timesteps).flip(0)
        self._before: tuple[Tensor, float] | None = None

    @classmethod
    def of(cls, model: DiffusionModel, sampler: str = "ddim", eta: float = 0.0) -> PrimDiffusionScheduler:
        """The scheduler of a model: its schedule and timesteps; ValueError for a schedule without a name."""
        chain = next(name for name, steps in CHAINS.items() if steps is model.chain)
        return cls(schedule_name(model.schedule), chain, sampler, eta, num_train_timesteps=model.schedule.length)

    @property
    def alphas_cumprod(self) -> Float[Tensor, "t"]:
        """alpha_bar of every step, float64."""
        return self.schedule.alpha_bar

    def __len__(self) -> int:
        return self.schedule.length

    def set_timesteps(self, num_inference_steps: int, device: torch.device | str | None = None) -> None:
        """Choose the descending `timesteps` [n]; ValueError for a number of steps that the chain cannot have."""
        self.num_inference_steps = num_inference_steps
        self.timesteps = torch.tensor(self.chain(len(self), num_inference_steps), device=device)
        self._before = None

    def scale_model_input(self, sample: Tensor, timestep: Tensor | int | None = None) -> Tensor:
        """Return the sample as it is: networks see it unscaled."""
        return sample

    def step(
        self,
        model_output: Float[Tensor, "b *s"],
        timestep: Tensor | int,
        sample: Float[Tensor, "b *s"],
        generator: Generators | None = None,
        return_dict: bool = True,
    ) -> DDIMSchedulerOutput | tuple[Tensor, Tensor]:
        """One step down `timesteps`: `prev_sample` and the clean guess `pred_original_sample`, both like `sample`.

        Steps are taken in order: dpmpp_2m keeps the guess before. Without a generator, noise is drawn from torch's own.
        Raises ValueError for a timestep that is not among `timesteps`.
        """
        t = int(timestep)
        chain = [*self.timesteps.tolist(), CLEAN]
        if t not in chain[:-1]:
            raise ValueError(f"timestep {t} is not one of this scheduler's {len(chain) - 1}: call set_timesteps first")
        index = chain.index(t)
        t_prev, x0 = chain[index + 1], model_output
        if self.prediction_type == "epsilon":
            x0 = (sample - self.schedule.noise(t) * model_output) / self.schedule.signal(t)
        draw = torch.default_generator if generator is None else generator
        if self.sampler == "ddpm":
            x = ddpm_step(self.schedule, sample, x0, t, t_prev, draw)
        elif self.sampler == "ddim":
            x = ddim_step(self.schedule, sample, x0, t, t_prev, draw, self.eta)
        else:
            x = dpmpp_2m_step(self.schedule, sample, x0, t, t_prev, self._before if index else None)
            self._before = x0, self.schedule.half_log_snr_gain(t, t_prev)
        return DDIMSchedulerOutput(prev_sample=x, pred_original_sample=x0) if return_dict else (x, x0)

    def add_noise(
        self, original_samples: Float[Tensor, "b *s"], noise: Float[Tensor, "b *s"], timesteps: Int[Tensor, "b"]
    ) -> Float[Tensor, "b *s"]:
        """Samples with noise of these steps (paper eq. 5)."""
        return self.schedule.q_sample(original_samples, timesteps.to(original_samples.device), noise)
