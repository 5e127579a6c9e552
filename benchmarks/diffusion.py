"""Quality, novelty and speed of generated humans, beside one Gaussian and the paper's voxel baseline.

`python benchmarks/diffusion.py --assets DIR --people DIR --reference DIR --old F --json F --table F` compares --count
samples of each set with renders of held-out meshes. The --reference folder has the feature network of
`python -m scripts.train_attribute_network --reference DIR --assets DIR`; portraits are kept there. Distances are
Frechet distances of features; `distance_floor` is that of other meshes, the best that a model can reach; `from_mesh`,
`payload` and `codec` are what stored humans lose before any network. `attribute_read_*` is the feature network's
accuracy on renders of held-out meshes. Figures that need an omitted option or set are null. Times are of two threads.
--quick takes few samples of each.

`python benchmarks/diffusion.py pictures --people DIR --neighbours docs/pictures/neighbours.png` renders humans from
consecutive seeds, not hand-picked, each beside the nearest human by latents in the folder, with distances (1 is the
median of the held-out set); --more is a second folder of people that it was trained on.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from diffusion_sets import (
    decoded,
    from_meshes,
    front,
    gaussian,
    generated,
    like,
    placed,
    seeds_of,
    stored,
    stored_voxels,
    voxels,
)
from march import from_script
from neighbours import nearest_stored
from PIL import Image, ImageDraw, ImageFont
from primdiffusion.diffusion.checkpoint import default_checkpoint, load_checkpoint
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.evaluation.metrics import frechet_distance, kernel_distance
from primdiffusion.evaluation.pretrained_networks import load_clip_vision, load_inception
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.human import place
from primdiffusion.people.assets import Assets, open_assets
from primdiffusion.people.payloads import rest_frames
from primdiffusion.people.stored_people import find_payloads, read_payloads
from primdiffusion.primitives.primitives import Payload, Primitives
from primdiffusion.render.march import march
from primdiffusion.training.latents import split_people
from record import report, run
from torch import Tensor
from voxel_baseline import load_voxel_model

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from scripts.feature_space.comparison import (
    Comparison,
    ReferenceSet,
    compare,
    open_reference_set,
    real_vs_real,
    table,
)
from scripts.feature_space.network import features_of
from scripts.feature_space.portraits import (
    COLOURINGS,
    PORTRAITS,
    Portrait,
    camera_of,
    made_gallery,
    mesh_sources,
)

Figures = dict[str, float | int | str | None]
SPEED_FIGURES = (
    "threads", "import_seconds", "load_seconds", "step_seconds_cpu", "generate_seconds_cpu",
    "generate_first_seconds_cpu", "generate_processor_seconds", "generate_seconds_a_person_of_8", "peak_gb",
)  # fmt: skip
NEED_MORE = ("nearest_neighbour_ratio_latent", "fid_ours", "kid_100_ours", "fid_clip_ours")
"""Figures that are null without people or weights."""
TITLES = {
    "ours": "ours",
    "like_held": "ours, with the attributes of held-out people",
    "unguided": "ours, guidance 0",
    "old": "ours, the checkpoint before",
    "gaussian": "one Gaussian of the training people",
    "voxel": "diffusion on 64^3 voxels",
    "floor": "other meshes",
    "payload": "training people, as fitted payloads",
    "codec": "training people, after our codec",
    "from_mesh": "people as payloads of `from_mesh`",
    "from_mesh_codec": "those after our codec",
    "old_codec": "those after the codec of the checkpoint before",
    "voxel_people": "training people, as 64^3 voxels",
    "voxel_codec": "training people, as 64^3 voxels after that codec",
}
SETS = tuple(TITLES)
REAL_SEED, HELD_SEED, OTHER_SEED = 0, 10_000_000, 20_000_000
"""First seeds of the meshes: the feature network's, those compared with, those that are made into payloads."""
ATTRIBUTES = (
    "sex", "age", "outfit", "pattern", "shoes", "hair", "hair_colour", "hat", "skin_tone", "height"
)  # fmt: skip
PAPER = (
    "The paper's Table 2 (FID with weights that are not at hand here, on other people; not to be compared in value): "
    "primitives FID_CLIP 12.11, FID 17.95, KID 1.63; voxels of 64^3 19.53, 81.78, 7.72."
)
BACKGROUND = (0.72, 0.72, 0.72)
CELL = 192
HEADING, NAME, CAPTION = 26, 24, 20
"""Heights of the headings' row and of captions, width of the rows' names, pixels."""
INK, PAGE = (30, 30, 30), (221, 221, 221)
FRONT, BACK, HEAD = (next(p for p in PORTRAITS if p.name == name) for name in ("front", "back", "head"))
MARGIN = 0.09
"""Share of the front view's width that is cut off at each side."""


def main() -> None:
    arguments = parsed()
    path = arguments.checkpoint or default_checkpoint()
    model = load_checkpoint(arguments.checkpoint)
    figures: Figures = {
        "checkpoint_mb": round(path.stat().st_size / 1e6, 2),
        "parameters": sum(p.numel() for p in model.denoiser.parameters()),
        **dict.fromkeys(NEED_MORE),
    }
    given = () if arguments.checkpoint is None else ("--checkpoint", str(arguments.checkpoint))
    repeats = "2" if arguments.quick else "5"
    figures |= from_script("diffusion_speed.py", SPEED_FIGURES, "--repeats", repeats, *given)
    rows: dict[str, Comparison] = {}
    reference = None
    if arguments.assets is not None:
        assets = open_assets(arguments.assets)
        reference = open_reference_set(
            mesh_sources(assets, seeds_of(arguments.meshes, REAL_SEED), COLOURINGS),
            mesh_sources(assets, seeds_of(arguments.meshes // 2, HELD_SEED), COLOURINGS),
            arguments.reference, progress("portraits"),
        )  # fmt: skip
        rows = comparisons(reference, model, assets, arguments)
    if arguments.people is not None:
        train, held = split_people(find_payloads(arguments.people), arguments.holdout, arguments.seed)
        figures |= photograph_figures(model, held, arguments)
        if not arguments.quick and model.card.get("geometries") == len(train):  # the people that it was trained on
            figures["nearest_neighbour_ratio_latent"] = latent_ratio(model, train, held)
    figures |= quality_figures(rows, reference)
    report(figures, arguments.json)
    text = table_of(rows, reference)
    print(text)
    if arguments.table is not None:
        arguments.table.write_text(text + "\n", encoding="utf-8")


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--assets", type=Path, help="MakeHuman's assets: meshes to compare with")
    parser.add_argument("--meshes", type=int, default=300, help="geometries of the reference; half as many held out")
    parser.add_argument("--old", type=Path, help="another checkpoint, to compare ours with")
    parser.add_argument("--people", type=Path, help="folder of payloads that the model was trained on")
    parser.add_argument("--holdout", type=float, default=0.08, help="share that was held out")
    parser.add_argument("--seed", type=int, default=0, help="seed of the training run")
    parser.add_argument(
        "--reference", type=Path, default=Path("runs/reference"), help="folder for portraits and feature network"
    )
    parser.add_argument("--checkpoint", type=Path, help="model to measure; the default one if omitted")
    parser.add_argument("--voxel", type=Path, help="baseline of train_baselines.py voxels")
    parser.add_argument("--inception", type=Path, help="weights for FID: pt_inception-2015-12-05-6726825d.pth")
    parser.add_argument("--clip", type=Path, help="weights for FID_CLIP: ViT-B/32 as .safetensors")
    parser.add_argument("--count", type=int, default=256, help="samples of each set")
    parser.add_argument("--sets", nargs="*", choices=SETS, default=SETS, help="sets to compare; default: all")
    parser.add_argument("--quick", action="store_true", help="16 samples of each set, no search among latents")
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument("--table", type=Path, help="markdown file for the table")
    return parser.parse_args()


def comparisons(
    reference: ReferenceSet, model: DiffusionModel, assets: Assets, arguments: argparse.Namespace
) -> dict[str, Comparison]:
    """Compare each available set with the held-out meshes."""
    count = 16 if arguments.quick else arguments.count
    seeds, held = seeds_of(count), reference.held.attributes
    sets: dict[str, Callable[[], Iterable[Primitives]]] = {
        "ours": lambda: placed(generated(model, seeds)),
        "like_held": lambda: placed(like(model, held[:: max(1, len(held) // count)][:count])),
        "unguided": lambda: placed(generated(model, seeds, guidance=0.0)),
        "gaussian": lambda: placed(gaussian(model, seeds)),
        "from_mesh": lambda: from_meshes(assets, seeds_of(count, OTHER_SEED)),
        "from_mesh_codec": lambda: from_meshes(assets, seeds_of(count, OTHER_SEED), model),
    }
    if arguments.old is not None:
        old = load_checkpoint(arguments.old)
        sets |= {
            "old": lambda: placed(generated(old, seeds)),
            "old_codec": lambda: from_meshes(assets, seeds_of(count, OTHER_SEED), old),
        }
    if arguments.people is not None:
        some = split_people(find_payloads(arguments.people), arguments.holdout, arguments.seed)[0][:count]
        sets |= {
            "payload": lambda: stored(some, 1),
            "voxel_people": lambda: stored_voxels(some, colourings=1),
        }
        if model.full_density == read_payloads(some[0]).full_density:
            sets |= {"codec": lambda: decoded(model, some, 1)}
        if arguments.voxel is not None:
            baseline = load_voxel_model(arguments.voxel)
            sets |= {"voxel_codec": lambda: stored_voxels(some, baseline, 1)}
    if arguments.voxel is not None:
        baseline = load_voxel_model(arguments.voxel)
        sets |= {"voxel": lambda: voxels(baseline, seeds)}
    rows = {"floor": real_vs_real(reference, count)}
    for name, make in sets.items():
        if name not in arguments.sets:
            continue
        rows[name] = compare(reference, features_of(reference.network, made_gallery(make())))
        print(name, rows[name], flush=True)
    return {name: rows[name] for name in SETS if name in rows}


def photograph_figures(model: DiffusionModel, held: list[Path], arguments: argparse.Namespace) -> Figures:
    """FID, KID * 100 and FID_CLIP of front views; None without the networks' weights.

    With few images, values are far above those of tens of thousands; compare only sets of equal size.
    """
    figures: Figures = {}
    networks = {"inception": (arguments.inception, load_inception), "clip": (arguments.clip, load_clip_vision)}
    features: dict[str, list[Tensor]] = {}
    for name, (path, load) in networks.items():
        if path is not None:
            network = load(path)
            made = placed(generated(model, seeds_of(arguments.count)))
            features[name] = [
                torch.cat([network(front(one)[None]) for one in people]) for people in (made, stored(held))
            ]
    if "inception" in features:
        figures["fid_ours"] = frechet_distance(*features["inception"])
        figures["kid_100_ours"] = 100 * kernel_distance(*features["inception"])
    if "clip" in features:
        figures["fid_clip_ours"] = frechet_distance(*features["clip"])
    return figures


def latent_ratio(model: DiffusionModel, train: list[Path], held: list[Path]) -> float:
    """Median latent distance to the nearest training sample: generated samples' over held-out ones'."""

    def encode(payload: object) -> Tensor:
        return model.encode(payload)  # pyright: ignore[reportArgumentType]

    made = [encode(human.payload).flatten() for human in generated(model, seeds_of(len(held)))]
    real = [encode(read_payloads(path).payload(0)).flatten() for path in held]
    found = nearest_stored(torch.stack([*made, *real]), train, encode, progress("latents"))
    return float(found.distance[: len(made)].median() / found.distance[len(made) :].median())


def quality_figures(rows: Mapping[str, Comparison], reference: ReferenceSet | None) -> Figures:
    """The named figures; None where not measured."""
    figures: Figures = {}
    for name in SETS:
        row = rows.get(name)
        for figure, field in (("distance", "frechet"), ("distance_std", "frechet_std"), ("kernel_distance", "kernel")):
            figures[f"{figure}_{name}"] = None if row is None else round(getattr(row, field), 5)
    ours, floor, old = (rows[name].frechet if name in rows else None for name in ("ours", "floor", "old"))
    figures["distance_ratio_floor"] = round(ours / floor, 4) if ours and floor else None
    figures["distance_ratio_old_checkpoint"] = round(ours / old, 4) if ours and old else None
    for name in ("ours", "unguided", "old", "gaussian", "voxel", "floor"):
        row = rows.get(name)
        suffix = "" if name == "ours" else f"_{name}"
        figures[f"nearest_neighbour_ratio{suffix}"] = None if row is None else round(row.nearest_ratio, 4)
        figures[f"precision{suffix}"] = None if row is None else round(row.precision, 4)
        figures[f"recall{suffix}"] = None if row is None else round(row.recall, 4)
    accuracy = {} if reference is None else reference.network.card.get("accuracy", {})
    figures |= {f"attribute_read_{name}": round(accuracy[name], 4) if name in accuracy else None for name in ATTRIBUTES}
    for name, gallery in (("train", reference and reference.train), ("held", reference and reference.held)):
        figures[f"people_{name}"] = None if gallery is None else len(gallery.pictures)
    return figures


def table_of(rows: Mapping[str, Comparison], reference: ReferenceSet | None) -> str:
    """Distances, and the accuracy of the feature network."""
    if reference is None:
        return "No assets were given (--assets): distances are not measured."
    accuracy = reference.network.card.get("accuracy", {})
    return "\n".join(
        [
            table({TITLES[name]: row for name, row in rows.items()}),
            "",
            PAPER,
            "",
            "Accuracy of the feature network on the held-out set; R^2 for skin tone and height:",
            "",
            "| " + " | ".join(accuracy) + " |",
            "|---" * len(accuracy) + "|",
            "| " + " | ".join(f"{value:.3f}" for value in accuracy.values()) + " |",
        ]
    )


def progress(what: str) -> Callable[[int, int], None]:
    def report(done: int, total: int) -> None:
        if done % 100 == 0 or done == total:
            print(what, done, "of", total, flush=True)

    return report


def pictures() -> None:
    parser = argparse.ArgumentParser(description="Renders generated humans beside their neighbours.")
    parser.add_argument("--people", type=Path, required=True, help="folder of the payloads that were trained on")
    parser.add_argument("--holdout", type=float, default=0.08)
    parser.add_argument("--seed", type=int, default=0, help="of the training run")
    parser.add_argument("--checkpoint", type=Path)
    parser.add_argument("--count", type=int, default=8, help="people in the picture")
    parser.add_argument("--more", type=Path, help="another folder of payloads that were trained on")
    parser.add_argument("--neighbours", type=Path, required=True, help="PNG to write")
    arguments = parser.parse_args()
    model = load_checkpoint(arguments.checkpoint)
    train, held = split_people(find_payloads(arguments.people), arguments.holdout, arguments.seed)
    train += [] if arguments.more is None else find_payloads(arguments.more)
    neighbours(model, train, held, arguments.count).save(arguments.neighbours, optimize=True)
    print(arguments.neighbours, "among", len(train))


def neighbours(model: DiffusionModel, train: Sequence[Path], held: Sequence[Path], count: int) -> Image.Image:
    """A column a seed: the human, and the training human nearest to it by latents."""

    def encode(payload: Payload) -> Tensor:
        return model.encode(payload)

    people = list(generated(model, seeds_of(count)))
    references = [read_payloads(path).payload(0) for path in held[:: max(len(held) // 32, 1)]]
    queries = torch.stack([encode(payload).flatten() for payload in (*(h.payload for h in people), *references)])
    found = nearest_stored(queries, train, encode, progress("latents"))
    new = found.distance[count:].median()
    rows: list[tuple[str, list[tuple[Primitives, str]]]] = [("generated", []), ("nearest in training", [])]
    for number, human in enumerate(people):
        rows[0][1].append((place(human), f"seed {number}"))
        nearest = stored_one(train[int(found.file[number])], int(found.colouring[number]))
        rows[1][1].append((nearest, f"{float(found.distance[number] / new):.2f}"))
    return sheet(rows, "Distances in units of the median held-out human's: 1 is as new as new humans are")


def stored_one(path: Path, colouring: int) -> Primitives:
    person = read_payloads(path)
    return Primitives.place(rest_frames(person.betas.numpy()), person.payload(colouring))


def sheet(rows: Sequence[tuple[str, Sequence[tuple[Primitives, str]]]], heading: str) -> Image.Image:
    """Rows of whole people over their heads, with captions."""
    columns = max(len(row) for _, row in rows)
    whole, below = round(CELL * (1 - 2 * MARGIN)), CELL // 2
    width, height = whole + below, CELL + CAPTION
    page = Image.new("RGB", (NAME + columns * width, HEADING + len(rows) * height), PAGE)
    pen, font = ImageDraw.Draw(page), ImageFont.load_default(14)
    pen.text((page.width / 2, HEADING / 2), heading, INK, font, anchor="mm")
    for row, (name, people) in enumerate(rows):
        top = HEADING + row * height
        label = Image.new("RGB", (height, NAME), PAGE)
        ImageDraw.Draw(label).text((height / 2, NAME / 2), name, INK, font, anchor="mm")
        page.paste(label.rotate(90, expand=True), (0, top))
        for column, (primitives, caption) in enumerate(people):
            left = NAME + column * width
            page.paste(Image.fromarray(portraits(primitives)), (left, top))
            pen.text((left + width / 2, top + CELL + CAPTION / 2), caption, INK, font, anchor="mm")
    return page


def portraits(primitives: Primitives) -> np.ndarray:
    """From the front, beside the head over the back view."""
    front, back, head = (seen(primitives, portrait, size) for portrait, size in ((FRONT, 0), (BACK, 1), (HEAD, 1)))
    cut = round(CELL * MARGIN)
    return np.concatenate([front[:, cut : CELL - cut], np.concatenate([head, back], 0)], 1)


def seen(primitives: Primitives, portrait: Portrait, halvings: int) -> np.ndarray:
    """sRGB bytes of a portrait."""
    view = march(primitives, camera_of(portrait, CELL >> halvings))
    return (encode_srgb(view.over(BACKGROUND)).clamp(0, 1) * 255).round().to(torch.uint8).numpy()


if __name__ == "__main__":
    run(main, pictures=pictures)
