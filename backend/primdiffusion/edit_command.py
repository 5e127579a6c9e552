"""The commands `primdiffusion vary`, `interpolate`, `inpaint` and `transfer`: a person in, one made of them out."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from primdiffusion.editing.shares import check_share

if TYPE_CHECKING:
    from jaxtyping import Bool
    from torch import Tensor

    from primdiffusion.diffusion.model import DiffusionModel
    from primdiffusion.editing.edit import OnStep
    from primdiffusion.human import Human


@dataclasses.dataclass(frozen=True, kw_only=True)
class Edit:
    """What all these commands are told."""

    person: tyro.conf.Positional[Path]
    """A .human.safetensors file; it stays as it is."""
    out: Path
    """Folder to write to: human.npz for Blender, person.human.safetensors to keep, and pictures."""
    steps: int = 30
    """Sampler steps, 1 to 1000."""
    checkpoint: Path | None = None
    """Trained model (.safetensors); without it the one that comes with the package."""
    size: int = 512
    """Pixels a side of the pictures."""

    def edit(self, human: Human, load: Callable[[], DiffusionModel], on_step: OnStep) -> Human:
        """The person made of `human`; `load` gives the model, where one is needed."""
        raise NotImplementedError

    def run(self) -> None:
        """Edits, and prints the folder. Raises ValueError, FileNotFoundError, OSError."""
        from tqdm import tqdm

        from primdiffusion.checkpoints import load_checkpoint
        from primdiffusion.human_file import load_human
        from primdiffusion.machine import best_device
        from primdiffusion.person_folder import write_person
        from primdiffusion.staging import staged

        if self.size < 1:
            raise ValueError(f"pictures of {self.size} pixels a side: choose 1 or more")
        began = time.perf_counter()
        with staged(self.out) as folder:
            human = load_human(self.person)
            with tqdm(unit="step", disable=None) as bar:

                def on_step(step) -> None:
                    bar.total = step.total
                    bar.update()

                edited = self.edit(human, lambda: load_checkpoint(self.checkpoint, best_device()), on_step)
            write_person(folder, edited, self.size)
        print(f"{self.out}  {edited.provenance['edits'][-1]['edit']}, {time.perf_counter() - began:.1f} s")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Vary(Edit):
    """Make a neighbour of a person: the same body, other clothes and face, by some noise and back."""

    amount: float = 0.5
    """0: the person themselves; 1: hardly anything is kept."""
    seed: int = 0
    """Which neighbour."""
    attributes: tuple[str, ...] = ()
    """What they shall become, NAME=VALUE; `info` lists the names and values that a checkpoint knows."""
    guidance: float = 1.5
    """How strongly attributes are insisted on: 1 plainly, more at the cost of variety."""

    def edit(self, human: Human, load: Callable[[], DiffusionModel], on_step: OnStep) -> Human:
        """See `editing.vary`."""
        from primdiffusion.diffusion.conditioning import read_attributes
        from primdiffusion.editing.vary import vary

        attributes = read_attributes(self.attributes)
        return vary(load(), human, self.amount, self.seed, self.steps, on_step, attributes, self.guidance)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Interpolate(Edit):
    """Make a person between two: a likely one all the way, with the body between theirs."""

    other: tyro.conf.Positional[Path]
    """A second .human.safetensors file."""
    fraction: float = 0.5
    """0: the first person, 1: the other one, exactly."""

    def edit(self, human: Human, load: Callable[[], DiffusionModel], on_step: OnStep) -> Human:
        """See `editing.interpolate`."""
        from primdiffusion.editing.interpolate import interpolate
        from primdiffusion.human_file import load_human

        return interpolate(load(), human, load_human(self.other), self.fraction, self.steps, on_step)


@dataclasses.dataclass(frozen=True, kw_only=True)
class EditRegion(Edit):
    """An edit of a part of the person; outside it not a bit changes."""

    region: tuple[str, ...] = ()
    """Parts of the body by name, such as top, bottom, shoes, hair, left_hand (all: docs/design/diffusion_edits.md)."""
    weights: Path | None = None
    """Instead of --region: an .npz with `weights`, a number from 0 to 1 for each vertex of human.npz's body."""
    seed: int = 0
    """Which of the possible results."""

    def chosen(self, human: Human) -> Bool[Tensor, "k"]:
        """The region's primitives. Raises ValueError unless just one of region and weights says which."""
        from primdiffusion.editing.painted import read_weights
        from primdiffusion.editing.regions import region_from_weights, region_of

        if bool(self.region) == (self.weights is not None):
            raise ValueError("say where to edit with either --region NAME or --weights FILE")
        if self.weights is not None:
            return region_from_weights(read_weights(self.weights), body_setup=human.body_setup)
        return region_of(self.region, human.body_setup)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Inpaint(EditRegion):
    """Make a region of a person anew, so that it fits the rest: re-dress them, or give them other hair."""

    attributes: tuple[str, ...] = ()
    """What the region shall become, NAME=VALUE as in outfit=suit; `info` lists what a checkpoint knows."""
    guidance: float = 1.5
    """How strongly attributes are insisted on: 1 plainly, more at the cost of variety."""

    def edit(self, human: Human, load: Callable[[], DiffusionModel], on_step: OnStep) -> Human:
        """See `editing.inpaint`."""
        from primdiffusion.diffusion.conditioning import read_attributes
        from primdiffusion.editing.inpaint import inpaint

        region, attributes = self.chosen(human), read_attributes(self.attributes)
        return inpaint(load(), human, region, self.seed, self.steps, attributes, self.guidance, on_step)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Transfer(EditRegion):
    """Give a region of a person the looks of another one."""

    source: Path
    """A .human.safetensors file: whose looks."""
    what: Literal["texture", "garment"] = "texture"
    """texture: colours alone, on the person's own shape; garment: shape too, where the cut differs."""
    harmonise: float = 0.0
    """0 copies exactly; up to 1, how much the region is then denoised so as to fit the rest."""

    def edit(self, human: Human, load: Callable[[], DiffusionModel], on_step: OnStep) -> Human:
        """See `editing.transfer`."""
        from primdiffusion.editing.inpaint import harmonise
        from primdiffusion.editing.transfer import transfer_garment, transfer_texture
        from primdiffusion.human_file import load_human

        check_share("harmonise", self.harmonise)
        region, source = self.chosen(human), load_human(self.source)
        edited = (transfer_garment if self.what == "garment" else transfer_texture)(source, human, region)
        if not self.harmonise:
            return edited
        return harmonise(load(), edited, region, self.harmonise, self.seed, self.steps, on_step)


COMMANDS: dict[str, type[Edit]] = {
    "vary": Vary,
    "interpolate": Interpolate,
    "inpaint": Inpaint,
    "transfer": Transfer,
}


def run(name: str, arguments: Sequence[str]) -> None:
    """One command line, errors as exceptions."""
    tyro.cli(COMMANDS[name], args=arguments, prog=f"primdiffusion {name}").run()
