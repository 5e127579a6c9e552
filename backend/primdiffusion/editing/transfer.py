"""What one person wears onto another, primitive by primitive: all people share one grid on the body (paper sec. 4)."""

from __future__ import annotations

import dataclasses

from jaxtyping import Bool
from torch import Tensor

from primdiffusion.editing.edit import check_correspondence, combined, with_edit
from primdiffusion.editing.regions import check_region, name_region
from primdiffusion.human import Human
from primdiffusion.primitives.primitives import Payload


def transfer_texture(source: Human, target: Human, region: Bool[Tensor, "k"]) -> Human:
    """The target with the source's colours in a region: the paper's exchange between corresponding primitives.

    Shapes stay the target's: densities, delta scales and betas. Right where both wear garments of one cut, and for
    skin, hair colour and patterns. Exact and without a model; the other half of the exchange is the same call with the
    people's parts swapped. Raises ValueError for a region that is empty or no mask of K, and for people who stand on
    different bodies.
    """
    payload = dataclasses.replace(target.payload, rgb=source.payload.rgb)
    return _transferred("transfer_texture", source, target, region, payload)


def transfer_garment(source: Human, target: Human, region: Bool[Tensor, "k"]) -> Human:
    """The target with all that fills the source's primitives in a region: colours, densities and delta scales.

    Right where the cut differs, as of a coat over a shirt or of long hair: the silhouette comes along. It sits on the
    target's own body, whose betas stay. At the region's border it may end abruptly; `harmonise` helps. Errors likewise.
    """
    return _transferred("transfer_garment", source, target, region, source.payload)


def _transferred(name: str, source: Human, target: Human, region: Tensor, payload: Payload) -> Human:
    region = check_region(region)
    check_correspondence("the source", source.body_setup, "the target", target.body_setup)
    edit = {"edit": name, "region": name_region(region, target.body_setup), "source": dict(source.provenance)}
    return with_edit(target, edit, combined(region, payload, target.payload))
