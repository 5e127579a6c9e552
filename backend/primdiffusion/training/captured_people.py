"""Encode captures as training payloads with the trained encoder, optionally refined."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.capture.conditioning import body_betas, conditioning_views, spread_cameras
from primdiffusion.capture.people_files import find_people
from primdiffusion.capture.reader import Captures
from primdiffusion.capture.render import SubjectResult
from primdiffusion.encoder.model import EncoderModel, betas_of_frames
from primdiffusion.files.arrays import read_arrays
from primdiffusion.files.json_files import parse_json, read_json
from primdiffusion.files.regular_files import as_file_error
from primdiffusion.formats.requests import EncodeSettings
from primdiffusion.human import Human
from primdiffusion.people.folder import CARD
from primdiffusion.people.payloads import store_payloads, voxels_from_payload
from primdiffusion.people.stored_people import read_payloads
from primdiffusion.primitives.primitives import Payload
from primdiffusion.render.descent import DescentSettings
from primdiffusion.runtime.failures import to_user_error
from primdiffusion.training.refine import refine


def encode_people(
    model: EncoderModel,
    captures: Captures,
    out: Path,
    settings: EncodeSettings = EncodeSettings(),  # noqa: B008
    cards: Mapping[str, Mapping[str, Any]] | None = None,
) -> Iterator[SubjectResult]:
    """Write NAME.npz of every subject into `out`; yields each outcome and continues after failures.

    The files are those of `primdiffusion payloads`, with delta scales and their source. A file of the same source is
    not written again ("skipped"). `cards` holds attributes and seeds of people by name (`read_cards`).

    Raises OSError where `out` cannot be written to.
    """
    out.mkdir(parents=True, exist_ok=True)
    about = {
        "captures": {key: value for key, value in captures.about.items() if key != "part_names"},
        "encoder": {"name": model.card.get("name", "unnamed"), "weights": _digest(model)},
        **{field.name: getattr(settings, field.name) for field in dataclasses.fields(EncodeSettings)},
    }
    for name in captures.subjects:
        card = (cards or {}).get(name, {})
        path = out / f"{name}.npz"
        source = json.dumps({"captured": name, **about}, sort_keys=True)
        if _is_current(path, source, card.get("attributes", {})):
            yield SubjectResult(name, "skipped")
            continue
        try:
            payloads, betas = looks_of(model, captures, name, settings)
        except Exception as error:
            failure = to_user_error(error)
            if failure is None:
                raise
            yield SubjectResult(name, "failed", str(failure))
            continue
        _store(path, payloads, betas, source, card)
        yield SubjectResult(name, "done", views=settings.views)


def looks_of(
    model: EncoderModel, captures: Captures, name: str, settings: EncodeSettings
) -> tuple[list[Payload], Float[Tensor, "10"]]:
    """Return the payloads of a subject, on the CPU, and the betas of the body that carries the boxes.

    Raises:
        FileNotFoundError, FileError: captures are missing or damaged.
        ValueError: they are of another body; the pictures lead to numbers that are not finite.
    """
    subject = captures.subject(name)
    given = body_betas(subject, model.body)
    betas, payloads, pictures = betas_of_frames(model.config, given), [], []
    if settings.refine_steps:
        frames = range(subject.frames)
        pictures = [conditioning_views(captures, name, frame, None, settings.refine_size) for frame in frames]
    for frame in choose_frames(subject.frames, settings.looks):
        cameras = spread_cameras(subject, frame, settings.views, model.body)
        payload = model.encode(conditioning_views(captures, name, frame, cameras), given).validate()
        if pictures:
            human = Human(payload, betas, {}, model.body_setup).to(payload.density.device)
            payload = refine(human, pictures, DescentSettings(settings.refine_steps, seed=settings.seed)).human.payload
        payloads.append(payload.to("cpu"))
    return payloads, betas


def choose_frames(frames: int, looks: int) -> list[int]:
    """Return `looks` evenly spaced frames from the first on, or all if there are fewer."""
    count = min(frames, looks)
    return [look * frames // count for look in range(count)]


def read_cards(people: Path) -> dict[str, Mapping[str, Any]]:
    """Return the cards that `primdiffusion people` wrote into a folder, by name: betas, attributes, seed.

    Raises:
        FileNotFoundError: the folder holds no people.
        ValueError: a card is damaged.
    """
    cards = {}
    for name, path in find_people(people).items():
        card = path.parent / CARD
        if card.is_file():
            with as_file_error(card, "is damaged", "make the human again"):
                cards[name] = dict(read_json(card))
    return cards


def _digest(model: EncoderModel) -> str:
    """Digest of the weights: payloads of another encoder are encoded again."""
    digest = hashlib.sha256()
    for value in model.encoder.state_dict().values():
        digest.update(value.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


def _store(path: Path, payloads: list[Payload], betas: Tensor, source: str, card: Mapping[str, Any]) -> None:
    entries: dict[str, np.ndarray | str | int] = {
        "voxels": np.stack([voxels_from_payload(payload) for payload in payloads]),
        "delta_scale": torch.stack([payload.delta_scale for payload in payloads]).half().numpy(),
        "betas": betas.double().numpy(),
        "attributes": json.dumps(card.get("attributes", {})),
        "source": source,
    }
    store_payloads(path, entries if card.get("seed") is None else {**entries, "seed": int(card["seed"])})


def _is_current(path: Path, source: str, attributes: Mapping[str, Any]) -> bool:
    """Return whether a file is intact and of the same source and attributes."""
    try:
        read_payloads(path)
        stored = read_arrays(path, ("source", "attributes"))
        return str(stored["source"]) == source and parse_json(str(stored["attributes"])) == attributes
    except (FileNotFoundError, ValueError, KeyError):
        return False
