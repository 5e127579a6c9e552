"""A captured person as a human: the encoder's payload on the body that its boxes sit on."""

from __future__ import annotations

from primdiffusion import __version__
from primdiffusion.capture.conditioning import CapturedPerson
from primdiffusion.encoder.encode import EncoderModel, betas_of_frames
from primdiffusion.human import Human


def reconstruct(model: EncoderModel, person: CapturedPerson) -> Human:
    """The person of these views, on the CPU; the same for the same model, views and device.

    Raises ValueError where the model's numbers are not finite.
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
    return Human(payload, betas_of_frames(model.config, person.betas), provenance).to("cpu").validate()
