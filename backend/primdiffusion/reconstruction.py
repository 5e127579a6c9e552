"""Reconstruct a captured subject as a `Human` with the encoder."""

from __future__ import annotations

from primdiffusion import __version__
from primdiffusion.capture.conditioning import CapturedPerson
from primdiffusion.encoder.model import EncoderModel, betas_of_frames
from primdiffusion.human import Human


def reconstruct(model: EncoderModel, person: CapturedPerson) -> Human:
    """Reconstruct the subject on the CPU; deterministic for a model, views and device.

    Raises ValueError if the model's output is not finite.
    """
    payload = model.encode(person.views, person.betas)
    provenance = {
        "reconstructed_from": person.subject,
        "frame": person.frame,
        "views": list(person.cameras),
        "checkpoint": model.card.get("name", "unnamed"),
        "full_density": model.config.full_density,
        "version": __version__,
    }
    betas = betas_of_frames(model.config, person.betas)
    return Human(payload, betas, provenance, model.body_setup).to("cpu").validate()
