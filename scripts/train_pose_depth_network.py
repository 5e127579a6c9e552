"""Train the network of joints, depth and attributes that `primdiffusion evaluate generation` judges with.

    python -m scripts.train_pose_depth_network --assets DIR --out backend/primdiffusion/weights/pose_depth.safetensors

Renders MakeHuman meshes (CC0) of seeds that no diffusion model is trained on, in random poses from random sides. Takes
minutes on one core. The card in the file states the errors on meshes of other seeds: the floor of the tables.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from jaxtyping import Float, UInt8
from primdiffusion.body.model import BodyPose
from primdiffusion.capture.poses import built_in_poses
from primdiffusion.evaluation.images import JOINTS, mesh_images
from primdiffusion.evaluation.pose_depth_network import (
    CELLS,
    INPUT,
    PCK_SHARE,
    PoseDepthNetwork,
    cell_means,
    joint_positions,
    load_pose_depth_network,
    shrunk,
)
from primdiffusion.files import tensor_file
from primdiffusion.files.whole_files import write_atomically
from primdiffusion.geometry.rotation import axis_angle_to_matrix, matrix_to_axis_angle
from primdiffusion.people.assets import Assets, open_assets
from primdiffusion.people.base_mesh import load_base_mesh
from primdiffusion.people.person import make_person
from torch import Tensor
from torch.nn import functional

from scripts.train_attribute_network import attribute_loss, labels_of, predicted_attributes, visible_vocabulary

JITTER = 0.15
"""Standard deviation of random rotations added to each joint of a pose, radians."""
HEATMAP_SIGMA = 0.8
"""Cells."""
SMALLEST_ZOOM, LARGEST_SHIFT = 0.75, 0.1
"""Pictures are shrunk by up to this factor and shifted by up to this share of their side."""
SWAPPED = [JOINTS.index(joint.replace("left", "*").replace("right", "left").replace("*", "right")) for joint in JOINTS]
"""The joint on the other side of the body, in mirrored pictures."""
FIRST_TRAINED, FIRST_HELD = 2_000_000, 3_000_000
"""First seeds of the meshes; no diffusion model is trained on them."""


@dataclasses.dataclass(frozen=True)
class TrainingImages:
    """Pictures and their truth."""

    pictures: UInt8[Tensor, "n 3 128 128"]
    joints: Float[Tensor, "n 12 2"]
    """In [0, 1] of the picture."""
    head_size: Float[Tensor, "n"]
    """As a share of the picture's side."""
    inverted: Float[Tensor, "n 32 32"]
    """1 / depth (1/m) of each cell's pixels that show the human; 0 for background."""
    attributes: tuple[Mapping[str, Any], ...]


def random_poses(count: int, generator: torch.Generator) -> BodyPose:
    """Mixtures of two built-in poses with a random rotation of every joint."""
    turns = matrix_to_axis_angle(built_in_poses().joint_rotation)
    first, second = (torch.randint(len(turns), (count,), generator=generator) for _ in range(2))
    share = torch.rand(count, 1, 1, generator=generator)
    mixed = turns[first].lerp(turns[second], share)
    mixed = mixed + JITTER * torch.randn(mixed.shape, generator=generator)
    return BodyPose(axis_angle_to_matrix(mixed), torch.zeros(count, 3))


def training_images(
    assets: Assets,
    seeds: Sequence[int],
    pictures_each: int,
    report: Callable[[int, int], None] = lambda done, total: None,
) -> TrainingImages:
    """Render meshes of `seeds`, each in `pictures_each` random poses from random sides; deterministic in the seeds."""
    base = load_base_mesh()
    pictures, joints, sizes, depths, attributes = [], [], [], [], []
    for number, seed in enumerate(seeds):
        person = make_person(assets, base, seed)
        generator = torch.Generator().manual_seed(seed)
        poses = random_poses(pictures_each, generator)
        yaws = (2 * np.pi * torch.rand(pictures_each, 1, generator=generator)).tolist()
        for image in mesh_images(person, poses, yaws, 2 * INPUT):
            assert image.joints is not None
            assert image.head_size is not None
            side = len(image.image.rgb)
            pictures.append(shrunk(image.pixels))
            joints.append(image.joints / side)
            sizes.append(image.head_size / side)
            depths.append(cell_means(1 / image.depth, image.mask))
            attributes.append(person.attributes)
        report(number + 1, len(seeds))
    return TrainingImages(
        torch.stack(pictures), torch.stack(joints), torch.tensor(sizes), torch.stack(depths), tuple(attributes)
    )


def fit_pose_depth_network(
    images: TrainingImages,
    *,
    epochs: int,
    batch: int = 16,
    learning_rate: float = 2e-3,
    seed: int = 0,
    report: Callable[[int, float], None] = lambda epoch, loss: None,
) -> PoseDepthNetwork:
    """Train a network; `report` receives each epoch and its mean loss. Deterministic for a seed and device."""
    vocabulary = visible_vocabulary(images.attributes)
    labels = labels_of(vocabulary, images.attributes)
    generator = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = PoseDepthNetwork(vocabulary).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
        optimiser = torch.optim.AdamW(network.parameters(), lr=learning_rate, weight_decay=0.02)
        steps = epochs * -(-len(images.pictures) // batch)
        scheduler = torch.optim.lr_scheduler.OneCycleLR(optimiser, learning_rate, total_steps=steps + 1, pct_start=0.1)
        for epoch in range(epochs):
            losses = []
            for chosen in torch.randperm(len(images.pictures), generator=generator).split(batch):
                pictures, joints, inverted = augmented(images, chosen, generator)
                seen = network(pictures.contiguous(memory_format=torch.channels_last))
                own = {name: values[chosen] for name, values in labels.items()}
                loss = joint_loss(seen.heatmaps, joints) + 2 * inverted_depth_loss(seen.depth, inverted)
                loss = loss + 0.1 * attribute_loss(predicted_attributes(network.heads, seen.features), own, vocabulary)
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()
                scheduler.step()
                losses.append(float(loss.detach()))
            report(epoch + 1, sum(losses) / len(losses))
    return network.to(memory_format=torch.contiguous_format).eval().requires_grad_(False)


def augmented(
    images: TrainingImages, chosen: Tensor, generator: torch.Generator
) -> tuple[Float[Tensor, "b 3 128 128"], Float[Tensor, "b 12 2"], Float[Tensor, "b 32 32"]]:
    """A batch mirrored, shrunk, shifted, blurred and in other light, as generated pictures may be."""
    count = len(chosen)
    pictures = images.pictures[chosen].float() / 255
    joints, inverted = images.joints[chosen], images.inverted[chosen]
    if float(torch.rand((), generator=generator)) < 0.5:
        pictures, inverted = pictures.flip(-1), inverted.flip(-1)
        joints = torch.stack([1 - joints[..., 0], joints[..., 1]], -1)[:, SWAPPED]
    zoom = SMALLEST_ZOOM + (1 - SMALLEST_ZOOM) * torch.rand(count, 1, generator=generator)
    shift = LARGEST_SHIFT * (2 * torch.rand(count, 2, generator=generator) - 1)
    # Output point p shows the input at (p - centre - shift) / zoom + centre, in grid_sample's [-1, 1].
    affine = torch.cat([torch.eye(2) / zoom[..., None], (-2 * shift / zoom)[..., None]], -1)
    grid = functional.affine_grid(affine, [count, 3, INPUT, INPUT], align_corners=False)
    pictures = 1 - functional.grid_sample(1 - pictures, grid, align_corners=False)
    coarse = functional.affine_grid(affine, [count, 1, CELLS, CELLS], align_corners=False)
    inverted = functional.grid_sample(inverted[:, None], coarse, mode="nearest", align_corners=False)[:, 0]
    joints = (joints - 0.5) * zoom[:, None] + 0.5 + shift[:, None]
    blurred = functional.avg_pool2d(pictures, 3, 1, 1, count_include_pad=False)
    pictures = pictures.lerp(blurred, torch.rand(count, 1, 1, 1, generator=generator))
    darker = 1 + 0.15 * torch.randn(count, 3, 1, 1, generator=generator)
    pictures = 1 - (1 - pictures) * darker  # white stays white
    pictures = pictures + 0.02 * torch.randn(pictures.shape, generator=generator)
    return pictures.clamp(0, 1), joints, inverted


def joint_loss(heatmaps: Float[Tensor, "b 12 32 32"], joints: Float[Tensor, "b 12 2"]) -> Tensor:
    """Cross entropy with Gaussians around the true joints."""
    cells = torch.arange(CELLS) + 0.5
    x, y = (-0.5 * ((cells - CELLS * joints[..., axis, None]) / HEATMAP_SIGMA).square() for axis in (0, 1))
    wanted = (y[..., :, None] + x[..., None, :]).flatten(2).softmax(-1)
    return -(wanted * heatmaps.flatten(2).log_softmax(-1)).sum(-1).mean()


def inverted_depth_loss(predicted: Float[Tensor, "b 32 32"], inverted: Float[Tensor, "b 32 32"]) -> Tensor:
    """Mean squared difference inside the human after aligning means and standard deviations, as `depth_error`."""
    mask = (inverted > 0).float()
    count = mask.sum((1, 2), keepdim=True).clamp_min(1)

    def standardised(values: Tensor) -> Tensor:
        centred = (values - (values * mask).sum((1, 2), keepdim=True) / count) * mask
        return centred / ((centred.square().sum((1, 2), keepdim=True) / count) + 1e-8).sqrt()

    # 1 / depth varies by a few percent: its scale is raised above the epsilon of the root.
    difference = standardised(predicted) - standardised(100 * inverted)
    return (difference.square().sum((1, 2), keepdim=True) / count).mean()


def held_out_errors(network: PoseDepthNetwork, images: TrainingImages, share: float) -> dict[str, float]:
    """PCKh (percent), joint error (percent of the side) and depth error x 100 on cells, of renders not trained on."""
    with torch.inference_mode():
        seen = [network(part.float() / 255) for part in images.pictures.split(64)]
    found = torch.cat([joint_positions(one.heatmaps) for one in seen])
    distance = (found - images.joints).norm(dim=-1)
    depth = inverted_depth_loss(torch.cat([one.depth for one in seen]), images.inverted)
    return {
        "pckh": 100 * float((distance <= share * images.head_size[:, None]).double().mean()),
        "joint_error": 100 * float(distance.mean()),
        "depth": 100 * float(depth),
    }


def save_pose_depth_network(path: Path, network: PoseDepthNetwork) -> None:
    """Write the network in half precision with its card, atomically."""
    tensors = {k: v.half() if v.is_floating_point() else v for k, v in network.state_dict().items()}
    metadata = {"space": json.dumps(network.vocabulary.to_json()), "card": json.dumps(network.card)}
    write_atomically(path, tensor_file.save(tensors, metadata=metadata))


@dataclasses.dataclass(frozen=True)
class Training:
    out: Path
    """File for the weights."""
    assets: Path | None = None
    """MakeHuman's assets."""
    people: int = 164
    """Number of meshes to train on."""
    held_out: int = 20
    """Number of meshes to measure errors on."""
    pictures: int = 32
    """Pictures of each mesh; half as many of held-out ones."""
    epochs: int = 18
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

        images = training_images(assets, seeds, self.pictures, report)
        network = fit_pose_depth_network(
            images,
            epochs=self.epochs,
            seed=self.seed,
            report=lambda epoch, loss: print(f"epoch {epoch}: loss {loss:.4f}", flush=True),
        )
        held = training_images(assets, held_seeds, self.pictures // 2, report)
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
