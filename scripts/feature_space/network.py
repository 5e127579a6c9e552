"""A feature space for humans: the features of a small network that predicts known attributes from portraits.

Networks pretrained on photographs need weights that are not always available. This one is trained within minutes on the
diffusion model's training set (scripts/train_attribute_network.py); sets are compared by the features it learns to
classify outfit, hair, age or pattern. Attributes show through any blur, so the energy of fine detail in each portrait
is added to the learned features.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, UInt8
from primdiffusion.diffusion.conditioning import AttributeVocabulary
from primdiffusion.evaluation.pose_depth_network import BANDS, attribute_heads, detail_energies
from primdiffusion.files import tensor_file
from primdiffusion.files.json_files import parse_json
from primdiffusion.files.regular_files import as_file_error
from torch import Tensor, nn

from scripts.feature_space.portraits import PORTRAITS

FEATURES = 96
WIDTHS = (16, 32, 64, 96, 96)
POOLED = 3
"""Side of the last feature map after pooling."""


class AttributeNetwork(nn.Module):
    """Convolutions on each portrait, a linear layer on all of them (the learned features), a linear head per attribute.

    Learned features and detail have unit variance over the training set.
    """

    detail_mean: Tensor
    detail_std: Tensor

    def __init__(self, vocabulary: AttributeVocabulary):
        super().__init__()
        self.vocabulary = vocabulary
        self.card: dict[str, Any] = {}
        layers, before = [], 4
        for width in WIDTHS:
            layers += [nn.Conv2d(before, width, 3, stride=2, padding=1), nn.BatchNorm2d(width), nn.ReLU()]
            before = width
        self.trunk = nn.Sequential(*layers, nn.AdaptiveAvgPool2d(POOLED))
        # Batch normalisation gives each feature unit variance over the training set: the unit of distances.
        self.features = nn.Sequential(
            nn.Dropout(0.2),
            nn.Linear(len(PORTRAITS) * before * POOLED**2, FEATURES),
            nn.BatchNorm1d(FEATURES, affine=False),
        )
        self.heads = attribute_heads(vocabulary, FEATURES)
        self.register_buffer("detail_mean", torch.zeros(len(PORTRAITS) * len(BANDS)))
        self.register_buffer("detail_std", torch.ones(len(PORTRAITS) * len(BANDS)))

    def forward(self, pictures: UInt8[Tensor, "n v h w 4"]) -> Float[Tensor, "n f"]:
        """Features of portraits: the learned ones, then detail."""
        detail = (detail_energies(pictures) - self.detail_mean) / self.detail_std
        return torch.cat([self.learned(pictures), detail], dim=1)

    def learned(self, pictures: UInt8[Tensor, "n v h w 4"]) -> Float[Tensor, "n 96"]:
        """Learned features of portraits."""
        values = pictures.movedim(-1, -3).flatten(0, 1).float() / 255 - 0.25
        return self.features(self.trunk(values).unflatten(0, pictures.shape[:2]).flatten(1))


def features_of(network: AttributeNetwork, pictures: UInt8[Tensor, "n v h w 4"]) -> Float[Tensor, "n f"]:
    """Features of any number of samples, computed in batches without gradients."""
    with torch.inference_mode():
        return torch.cat([network(part) for part in pictures.split(64)]).clone()


def load_attribute_network(path: Path) -> AttributeNetwork:
    """Load what scripts/train_attribute_network.py wrote.

    Raises FileNotFoundError, and ValueError for an unreadable file.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no feature network at {path}: train one by scripts/train_attribute_network.py")
    reason = "is not a feature network of this version"
    with as_file_error(path, reason, "train it again by scripts/train_attribute_network.py", OSError, RuntimeError):
        tensors, metadata = tensor_file.read(path)
        vocabulary = AttributeVocabulary.from_json(parse_json(metadata["answers"]))
        network = tensor_file.load_network(lambda: AttributeNetwork(vocabulary), tensors)
        network.card = dict(parse_json(metadata.get("card", "{}")))
    return network.eval().requires_grad_(False)
