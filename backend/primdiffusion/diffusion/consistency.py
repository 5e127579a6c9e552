"""Whether the parts of a model that were read from a file fit each other."""

from __future__ import annotations

from primdiffusion.body.measures import LARGEST_BETA
from primdiffusion.diffusion.codec import VALUES, LinearCodec
from primdiffusion.diffusion.conditioning import AttributeVocabulary
from primdiffusion.diffusion.gaussian import PersonPrior
from primdiffusion.diffusion.model import ShapePrior
from primdiffusion.geometry.records import check_shapes
from primdiffusion.primitives.primitives import GRID, K

LARGEST_ENTRY = 1.01
"""Of a row of length 1, rounded to half precision."""


def check_codec(codec: LinearCodec) -> None:
    """Raise ValueError unless the tensors of a codec fit each other and the primitives."""
    check_shapes(codec)
    if not bool((codec.weight > 0).all()) or bool((codec.basis.abs() > LARGEST_ENTRY).any()):
        raise ValueError("a weight of the codec is not positive, or its basis has rows longer than 1")
    if codec.region.shape != (K,) or not bool(((codec.region >= 0) & (codec.region < len(codec.basis))).all()):
        raise ValueError(f"regions of the codec are not {K} numbers below {len(codec.basis)}")
    if tuple(codec.mean.shape) != (K, VALUES):
        raise ValueError(f"mean has shape {tuple(codec.mean.shape)}, not {K} x {VALUES}")


def check_parts(codec: LinearCodec, prior: PersonPrior, shapes: ShapePrior, vocabulary: AttributeVocabulary) -> None:
    """Raise ValueError unless prior, body shapes and vocabulary have the sizes and values of one model, with a codec
    that passes `check_codec`."""
    latents = (codec.channels, GRID, GRID)
    if latents != tuple(prior.mean.shape):
        raise ValueError(f"codec latents are {latents}, the network expects {tuple(prior.mean.shape)}")
    check_shapes(codec, prior)
    check_shapes(shapes)
    _check_values(prior, shapes)
    components, drawn = prior.basis.shape
    if drawn % GRID**2 or not 0 < drawn <= prior.mean.numel():
        raise ValueError(f"basis has rows of {drawn}, which are no whole channels of {tuple(prior.mean.shape)}")
    if shapes.weight.shape[1] > components:
        raise ValueError(f"body shapes depend on {shapes.weight.shape[1]} components of {components}")
    if prior.kind.shape[-1] not in (0, vocabulary.width):
        raise ValueError(f"parts are described by {prior.kind.shape[-1]} values, attributes by {vocabulary.width}")


def _check_values(prior: PersonPrior, shapes: ShapePrior) -> None:
    for name, values in (("rest_variance", prior.rest_variance), ("variance", prior.variance), ("limit", shapes.limit)):
        if bool((values < 0).any()):
            raise ValueError(f"{name} has negative values")
    if bool((shapes.limit > LARGEST_BETA).any()):
        raise ValueError(f"body shapes may have betas over {LARGEST_BETA:g}")
    for name, rows in (("basis", prior.basis), ("axes", prior.axes)):
        if bool((rows.abs() > LARGEST_ENTRY).any()):
            raise ValueError(f"{name} has rows longer than 1")
