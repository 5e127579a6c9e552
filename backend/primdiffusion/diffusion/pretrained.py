"""Write a model as a folder in the layout of the Hugging Face hub, with its card; `load_checkpoint` reads it."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from primdiffusion.diffusion.checkpoint import FORMAT, WEIGHTS, read_card, read_metadata, save_checkpoint
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.diffusion.schedule import schedule_name
from primdiffusion.files.json_files import parse_json
from primdiffusion.files.whole_files import atomic_folder

_SECTIONS = ("held_out_rms_x0_error", "limits")


def model_card(card: Mapping[str, Any]) -> str:
    """Return the card as Markdown, for docs/model_card.md."""
    title = card.get("name", "unnamed")
    facts = {key: value for key, value in card.items() if key not in ("name", "attributes", *_SECTIONS)}
    return "\n".join(
        [
            f"# Model card: {title}",
            "",
            "Generated from the checkpoint by `python -m primdiffusion.diffusion.pretrained`; do not edit.",
            "",
            *(f"- {key.replace('_', ' ')}: {_plain(value)}" for key, value in facts.items()),
            "",
            *_attribute_section(card.get("attributes", {})),
            *_error_section(card.get("held_out_rms_x0_error")),
            "## Limits",
            "",
            *(f"- {limit}" for limit in card.get("limits", ())),
            "",
        ]
    )


def _error_section(errors: Mapping[str, Mapping[str, float]] | None) -> list[str]:
    """Lines of the section on the denoiser's errors; empty where they were not measured."""
    if errors is None:
        return []
    return [
        "## Held-out error",
        "",
        "Root mean square error of x0 predictions in latent units at steps t of 1000, on people with held-out",
        "geometry and the same noise. `gaussian`: the closed-form denoiser of one Gaussian fitted to",
        "the training set; `mixture`: of a mixture of Gaussians; `denoiser`: this checkpoint.",
        "",
        *_error_table(errors),
        "",
    ]


def _error_table(errors: Mapping[str, Mapping[str, float]]) -> list[str]:
    """Lines of a table of errors, a row for each method and a column for each t."""
    levels = list(next(iter(errors.values())))
    rows = [f"| {name} | " + " | ".join(f"{by[level]:.4f}" for level in levels) + " |" for name, by in errors.items()]
    return ["| t | " + " | ".join(levels) + " |", "|---" * (len(levels) + 1) + "|", *rows]


def _attribute_section(attributes: Mapping[str, Any]) -> list[str]:
    """Lines of the section on attributes; empty for an unconditional model."""
    values = [f"- {name}: {', '.join(words)}" for name, words in attributes.get("categories", {}).items()]
    numbers = [
        f"- {name}: mean {mean:.3g}, standard deviation {spread:.2g}"
        for name, (mean, spread) in attributes.get("scalars", {}).items()
    ]
    return ["## Attributes", "", *values, *numbers, ""] if values or numbers else []


def _plain(value: object) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {item}" for key, item in value.items()) or "none"
    return str(value)


if __name__ == "__main__":
    print(model_card(read_card()), end="")


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
    with atomic_folder(folder) as unfinished:
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
