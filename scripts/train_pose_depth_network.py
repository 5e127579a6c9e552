"""Train the network of joints, depth and attributes that `primdiffusion evaluate generation --table` judges with.

    python scripts/train_pose_depth_network.py --assets DIR --out backend/primdiffusion/weights/pose_depth.safetensors

Renders MakeHuman meshes (CC0) of seeds that no diffusion model is trained on, in random poses from random sides. Takes
minutes on one core. The card in the file states the errors on meshes of other seeds: the floor of the tables.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import torch
import tyro
from primdiffusion.evaluation.pose_depth_metrics import PCK_SHARE
from primdiffusion.evaluation.pose_depth_network import load_pose_depth_network, save_pose_depth_network
from primdiffusion.evaluation.pose_depth_training import fit_pose_depth_network, held_out_errors, training_shots
from primdiffusion.people.assets import open_assets

FIRST_TRAINED, FIRST_HELD = 2_000_000, 3_000_000


@dataclasses.dataclass(frozen=True)
class Training:
    out: Path
    """File for the weights."""
    assets: Path | None = None
    """MakeHuman's assets."""
    people: int = 84
    """Number of meshes to train on."""
    held_out: int = 20
    """Number of meshes to measure errors on."""
    pictures: int = 32
    """Pictures of each mesh; half as many of held-out ones."""
    epochs: int = 20
    """Passes over all pictures."""
    seed: int = 0
    """Seed of weights and batches."""

    def run(self) -> None:
        torch.set_num_threads(1)  # sums in one order: the same weights on every machine of a kind
        assets = open_assets(self.assets)
        seeds = range(FIRST_TRAINED, FIRST_TRAINED + self.people)
        held_seeds = range(FIRST_HELD, FIRST_HELD + self.held_out)

        def report(done: int, total: int) -> None:
            print(f"rendered {done} of {total} meshes", flush=True)

        shots = training_shots(assets, seeds, self.pictures, report)
        network = fit_pose_depth_network(
            shots,
            epochs=self.epochs,
            seed=self.seed,
            report=lambda epoch, loss: print(f"epoch {epoch}: loss {loss:.4f}", flush=True),
        )
        held = training_shots(assets, held_seeds, self.pictures // 2, report)
        network.card = {
            "trained_on": f"{self.people} MakeHuman meshes (CC0), seeds {seeds[0]} to {seeds[-1]}, {self.pictures} "
            "random poses and views each",
            "epochs": self.epochs,
            "seed": self.seed,
            "held_out": f"{self.held_out} meshes, seeds {held_seeds[0]} to {held_seeds[-1]}",
        }
        save_pose_depth_network(self.out, network)
        network = load_pose_depth_network(self.out)  # in the precision of the file
        network.card["errors"] = held_out_errors(network, held, PCK_SHARE)
        save_pose_depth_network(self.out, network)
        print(network.card["errors"])


if __name__ == "__main__":
    tyro.cli(Training, description=__doc__).run()
