"""The card of a checkpoint as a page in Markdown."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from primdiffusion.diffusion.checkpoint import read_card

_SECTIONS = ("held_out_rms_x0_error", "limits")


def model_card(card: Mapping[str, Any]) -> str:
    """Return the card as Markdown, for docs/model_card.md."""
    title = card.get("name", "unnamed")
    facts = {key: value for key, value in card.items() if key not in ("name", "attributes", *_SECTIONS)}
    return "\n".join(
        [
            f"# Model card: {title}",
            "",
            "Generated from the checkpoint by `python -m primdiffusion.diffusion.model_card`; do not edit.",
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
