"""Write a model as a folder, laid out as the Hugging Face hub keeps models; `load_checkpoint` reads it."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from primdiffusion.diffusion.checkpoint import FORMAT, WEIGHTS, read_card, read_metadata, save_checkpoint
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.diffusion.model_card import model_card
from primdiffusion.diffusion.schedule import schedule_name
from primdiffusion.files.json_files import parse_json
from primdiffusion.files.whole_files import staged

CONFIG, CARD = "config.json", "README.md"
_LICENCE = re.compile(r"[A-Za-z0-9.+-]+", re.ASCII)


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
