"""A model as a folder, laid out as huggingface's hub keeps models: weights, config.json and a model card."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from primdiffusion.diffusion.checkpoint import FORMAT, load_checkpoint, read_card, read_metadata, save_checkpoint
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.diffusion.model_card import model_card
from primdiffusion.diffusion.schedule import schedule_name
from primdiffusion.formats.json_files import parse_json
from primdiffusion.formats.regular_files import FileError, read_regular
from primdiffusion.formats.whole_files import staged

WEIGHTS, CONFIG, CARD = "model.safetensors", "config.json", "README.md"
_COMMIT = re.compile(r"[0-9a-zA-Z_-]{1,64}", re.ASCII)
_LICENCE = re.compile(r"[A-Za-z0-9.+-]+", re.ASCII)


def load_pretrained(path: Path | str, device: torch.device | str = "cpu") -> DiffusionModel:
    """Load a model from a checkpoint, a folder of `save_pretrained`, or a repository in a local hub cache.

    Downloads nothing. Errors as in `load_checkpoint`; FileNotFoundError also without such a folder, FileError for
    a folder without a model or with several snapshots and no main branch.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(
            f"there is no file or folder {path}: models are read from this disk alone, so download "
            "it first, for example with hf download"
        )
    return load_checkpoint(_weights_in(path) if path.is_dir() else path, device)


def save_pretrained(model: DiffusionModel, folder: Path | str) -> Path:
    """Write model.safetensors, config.json and README.md, all or none; returns the folder, which is created if missing.

    Raises ValueError for a model imported from the released weights, which needs the user's own body file, and for a
    schedule without a name; OSError.
    """
    if model.body_setup is not None:
        raise ValueError(
            "this model was imported from the released weights and needs your body file: copy its checkpoint instead"
        )
    folder, schedule = Path(folder), schedule_name(model.schedule)
    with staged(folder) as unfinished:
        weights = unfinished / WEIGHTS
        save_checkpoint(weights, model, schedule)
        metadata = read_metadata(weights, (FORMAT,))
        config = {
            "library_name": "primdiffusion",
            "format_version": metadata["format_version"],
            **parse_json(metadata["architecture"]),
        }
        (unfinished / CONFIG).write_text(json.dumps(config, indent=2) + "\n", encoding="utf-8", newline="\n")
        (unfinished / CARD).write_text(_hub_card(read_card(weights)), encoding="utf-8", newline="\n")
    return folder


def _weights_in(folder: Path) -> Path:
    """The checkpoint in a folder: its own, or that of the commit of a hub cache's main branch, or its only one."""
    if (folder / WEIGHTS).is_file():
        return folder / WEIGHTS
    main = folder / "refs" / "main"
    if main.is_file():
        commit = read_regular(main, 1024).decode("ascii", errors="replace").strip()
        found = [folder / "snapshots" / commit / WEIGHTS] if _COMMIT.fullmatch(commit) else []
    else:
        found = sorted((folder / "snapshots").glob(f"*/{WEIGHTS}"))
    found = [path for path in found if path.is_file()]
    if len(found) > 1:
        names = ", ".join(path.parent.name for path in found)
        raise FileError(folder, f"holds several snapshots ({names})", "give the folder of one of them")
    if not found:
        raise FileError(
            folder,
            f"holds no {WEIGHTS}, nor a hub snapshot with one",
            "give a folder of save_pretrained or hf download",
        )
    return found[0]


def _hub_card(card: Mapping[str, Any]) -> str:
    """The model card with the header that the hub reads."""
    licence = str(card.get("licence", ""))
    header = [
        "---",
        "library_name: primdiffusion",
        f"license: {licence.lower() if _LICENCE.fullmatch(licence) else 'other'}",
        "tags: [3d, human-generation, diffusion]",
        "---",
        "",
    ]
    return "\n".join(header) + model_card(card)
