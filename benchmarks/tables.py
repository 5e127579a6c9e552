"""The paper's Table 2: primitives, one latent vector a human and voxels, trained on equal people for equal time.

`python benchmarks/tables.py --models DIR --assets DIR --json docs/results/tables.json --table
docs/results/tables_table.md` samples DIR/ours/model.safetensors and DIR/latents/model.safetensors of
train_baselines.py and DIR/voxels/voxel.safetensors, and judges --count humans of each by the
code of `primdiffusion evaluate generation`: 512 x 512 pictures over white from --views sides beside renders
of twice as many meshes of seeds that no model trains on. All are in the rest pose, since voxels have no other.
Distances, PCKh and depth errors are of our own network; `_real` are of the renders, `_floor` of its card. `_default` is
the default model, which had more people and time.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from diffusion_sets import TOGETHER, generated, seeds_of
from latent_baseline import sample_people
from primdiffusion.body.model import BodyPose, J
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.evaluation.images import TestImage, human_images, mesh_images_of_seeds, primitive_images
from primdiffusion.evaluation.pose_depth_network import load_pose_depth_network
from primdiffusion.evaluation.tables import (
    Cell,
    Networks,
    Scores,
    compare_pictures,
    look_at_pictures,
    reference_cells,
    table,
)
from primdiffusion.files.whole_files import atomic_path
from primdiffusion.human import Human, pose_body
from primdiffusion.people.assets import Assets, open_assets
from primdiffusion.render.march import MarchSettings
from record import command_line, report
from voxel_baseline import VoxelModel, load_voxel_model

REAL_SEED = 3_000_000
"""First seed of the meshes, as of `primdiffusion evaluate generation`."""
REAL_EACH = 2
"""Meshes for each human of a model: one half of their pictures is compared with all of the model's."""
REST = BodyPose.from_axis_angle(torch.zeros(1, 3 * J))
MARCH = MarchSettings()
MOST_APART = 0.05
"""Relative difference of training times up to which they are called equal."""
COMPARED = ("ours", "latents", "voxels")
COLUMNS = {"own_distance": "distance", "own_pckh": "pckh", "own_depth": "depth_error"}
Figures = dict[str, float | int | str | None]


class Model(NamedTuple):
    """One of the models that are compared."""

    card: Mapping[str, Any]
    images: Callable[[Sequence[int], int], Iterator[TestImage]]
    """Pictures of the humans of these seeds from so many sides."""


def main() -> None:
    arguments = parsed()
    torch.set_num_threads(arguments.threads)
    models = read_models(arguments.models, arguments.without_default)
    rows = judged_rows(models, open_assets(arguments.assets), arguments.count, arguments.views, arguments.found)
    figures = figures_of(rows, models)
    figures |= {"samples": arguments.count, "pictures": arguments.count * arguments.views}
    figures |= {"real_meshes": REAL_EACH * arguments.count}
    report(figures, arguments.json)
    choices = {
        "pictures": f"{arguments.count} humans from {arguments.views} sides in the rest pose; "
        f"{REAL_EACH * arguments.count} meshes"
    }
    text = table(rows, choices)
    print(text)
    if arguments.table is not None:
        arguments.table.write_text(text + "\n", encoding="utf-8")


def parsed() -> argparse.Namespace:
    parser = command_line(__doc__)
    parser.add_argument("--models", type=Path, required=True, help="folder of ours, latents and voxels")
    parser.add_argument("--assets", type=Path, help="MakeHuman asset folder (or PRIMDIFFUSION_ASSETS)")
    parser.add_argument("--count", type=int, default=64, help="humans of each model")
    parser.add_argument("--views", type=int, default=4, help="sides of each")
    parser.add_argument("--found", type=Path, help="folder in which what was seen of humans is kept, to go on later")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--without-default", action="store_true", help="leave the default model out")
    parser.add_argument("--table", type=Path, help="markdown file for the table")
    return parser.parse_args()


def read_models(folder: Path, without_default: bool = False) -> dict[str, Model]:
    """The models by name.

    Raises FileNotFoundError and ValueError for models that are missing, damaged, or not trained on equal people for
    equal time.
    """
    ours, latents = (load_checkpoint(folder / name / "model.safetensors") for name in ("ours", "latents"))
    voxels = load_voxel_model(folder / "voxels" / "voxel.safetensors")

    models = {
        "ours": Model(ours.card, lambda seeds, views: images_of(generated(ours, seeds), views)),
        "latents": Model(latents.card, lambda seeds, views: images_of(iter(sample_people(latents, seeds)), views)),
        "voxels": Model(voxels.card, lambda seeds, views: voxel_images(voxels, seeds, views)),
    }
    check_equal({name: model.card for name, model in models.items()})
    if not without_default:
        default = load_checkpoint()
        models["default"] = Model(default.card, lambda seeds, views: images_of(generated(default, seeds), views))
    return models


def check_equal(cards: Mapping[str, Mapping[str, Any]]) -> None:
    """Raise ValueError unless the models had equal people and time."""
    minutes = {name: float(card["minutes"]) for name, card in cards.items()}
    people = {name: int(card["people"]) for name, card in cards.items()}
    if len(set(people.values())) > 1 or max(minutes.values()) > (1 + MOST_APART) * min(minutes.values()):
        trained = ", ".join(f"{name} {people[name]} people, {minutes[name]:g} minutes" for name in cards)
        raise ValueError(f"the models were not trained equally ({trained}): train them again")


def images_of(humans: Iterator[Human], views: int) -> Iterator[TestImage]:
    """Pictures of humans."""
    for human in humans:
        yield from human_images(human, REST, views, MARCH, torch.device("cpu"))


def voxel_images(model: VoxelModel, seeds: Sequence[int], views: int) -> Iterator[TestImage]:
    """Pictures of grids around the bodies that were sampled with them."""
    for person in model.sample(seeds):
        posed = pose_body(person.betas, REST.map(lambda t: t[0]))
        yield from primitive_images(model.primitives(person.grid), posed, views, MARCH)


def judged_rows(
    models: Mapping[str, Model], assets: Assets, count: int, views: int, found: Path | None = None
) -> dict[str, dict[str, Cell]]:
    """The table's rows: each model's, the real pictures', and the floor."""
    networks = Networks(load_pose_depth_network())
    found = None if found is None else found / f"{views}_views"
    seeds_of_real = seeds_of(REAL_EACH * count, REAL_SEED)
    real = judged(
        "real", lambda seeds: mesh_images_of_seeds(assets, seeds, REST, views), seeds_of_real, networks, found
    )
    rows: dict[str, dict[str, Cell]] = {}
    own: dict[str, Cell] = {}
    for name, model in models.items():
        fake = judged(name, lambda seeds, m=model: m.images(seeds, views), seeds_of(count), networks, found)
        cells = compare_pictures(fake, real)
        rows[name], own = cells["generated"], cells["real"]
    return {**rows, "real": own, "floor": reference_cells(networks.own.card)}


def judged(
    name: str,
    images: Callable[[Sequence[int]], Iterator[TestImage]],
    seeds: Sequence[int],
    networks: Networks,
    found: Path | None = None,
) -> Scores:
    """What our network finds in a set, TOGETHER humans at a time; kept in the folder `found`, and read from there."""
    parts = []
    for first in range(0, len(seeds), TOGETHER):
        some = seeds[first : first + TOGETHER]
        path = None if found is None else found / f"{name}_{some[0]}_{len(some)}.json"
        if path is not None and path.is_file():
            parts.append(json.loads(path.read_text(encoding="utf-8")))
            continue
        one = look_at_pictures(images(some), networks)
        features = {key: values.tolist() for key, values in one.features.items()}
        parts.append({"features": features, "own": one.correct, "depth": one.depth})
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_path(path) as unfinished:
                unfinished.write_text(json.dumps(parts[-1]), encoding="utf-8")
        print(name, first + len(some), "of", len(seeds), flush=True)
    features = {key: torch.cat([torch.tensor(part["features"][key]) for part in parts]) for key in parts[0]["features"]}
    correct, depth = ([value for part in parts for value in part[key]] for key in ("own", "depth"))
    return Scores(len(features["own"]), features, correct, depth)


def figures_of(rows: Mapping[str, Mapping[str, Cell]], models: Mapping[str, Model]) -> Figures:
    """Figures by name; null where a row has none."""
    figures: Figures = {}
    for row in (*COMPARED, "default", "real", "floor"):
        for column, name in COLUMNS.items():
            cell = rows.get(row, {}).get(column, Cell(None))
            if (row, name) != ("floor", "distance"):
                figures[f"{name}_{row}"] = None if cell.value is None else round(cell.value, 3)
    for name in COMPARED:
        card = models[name].card
        figures |= {f"{what}_{name}": card[what] for what in ("minutes", "people", "geometries")}
        figures |= {f"steps_{network}_{name}": steps for network, steps in card["steps"].items()}
    return figures


if __name__ == "__main__":
    main()
