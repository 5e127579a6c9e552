"""Train torchvision's keypoint network on captures annotated in COCO's format, until it knows them by heart.

pip install torchvision
primdiffusion people --assets makehuman --count 2 --out people
primdiffusion captures render --people people --out captures --pose-count 5 --cameras 20 --size 160 \\
    --passes img mask depth
primdiffusion captures coco captures
python examples/train_keypoints.py --captures captures
"""

import argparse
import json
import random
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torchvision.models.detection import keypointrcnn_resnet50_fpn


def main() -> None:
    """Prints the mean loss of every ten steps and the error of keypoints at the end, and saves the weights."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--captures", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--out", type=Path, default=Path("keypoints.pth"))
    arguments = parser.parse_args()

    coco = json.loads((arguments.captures / "annotations.json").read_text(encoding="utf-8"))
    files = {image["id"]: arguments.captures / image["file_name"] for image in coco["images"]}
    annotations = [one for one in coco["annotations"] if one["num_keypoints"]]
    side = max(image["width"] for image in coco["images"])
    sizes = {"min_size": side, "max_size": side}
    fewer = {"box_batch_size_per_image": 16, "rpn_pre_nms_top_n_train": 200, "rpn_post_nms_top_n_train": 50}
    model = keypointrcnn_resnet50_fpn(weights=None, weights_backbone=None, num_keypoints=17, **sizes, **fewer)
    optimiser = torch.optim.AdamW(model.parameters(), lr=2e-4)
    losses = []
    for step in range(1, arguments.steps + 1):
        images, targets = zip(*(sample(files, one) for one in random.sample(annotations, arguments.batch)), strict=True)
        loss = torch.stack(list(model(list(images), list(targets)).values())).sum()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
        if step % 10 == 0:
            print(f"step {step}  loss {np.mean(losses[-10:]):.2f}", flush=True)
    torch.save(model.state_dict(), arguments.out)
    model.eval()
    with torch.no_grad():
        errors = torch.cat([error(model, *sample(files, one)) for one in annotations])
    print(f"keypoints are off by {errors.median():.2f} pixels in the median, 90 % by {errors.quantile(0.9):.2f}")


def sample(files: dict[int, Path], one: dict) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """An image [3, H, W] in 0 ... 1, and its human as torchvision's networks take it. One human stands in an image."""
    image = np.asarray(Image.open(files[one["image_id"]]).convert("RGB")).copy()
    left, top, width, height = one["bbox"]
    keypoints = torch.tensor(one["keypoints"], dtype=torch.float32).reshape(1, 17, 3)
    target = {
        "boxes": torch.tensor([[left, top, left + width, top + height]], dtype=torch.float32),
        "labels": torch.ones(1, dtype=torch.int64),
        "keypoints": torch.cat([keypoints[..., :2], keypoints[..., 2:].clamp(max=1)], -1),
    }
    return torch.from_numpy(image).movedim(-1, 0) / 255, target


def error(model: torch.nn.Module, image: torch.Tensor, target: dict[str, torch.Tensor]) -> torch.Tensor:
    """Distances of labelled keypoints from those of the most probable human found, pixels; infinite if none is."""
    found, (true,) = model([image])[0]["keypoints"], target["keypoints"]
    labelled = true[:, 2] > 0
    nearest = found[0, labelled, :2] if len(found) else torch.full((int(labelled.sum()), 2), torch.inf)
    return (nearest - true[labelled, :2]).norm(dim=-1)


if __name__ == "__main__":
    main()
