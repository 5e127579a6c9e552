"""Transfer clothes between humans, primitive by primitive: all share one grid on the body (paper sec. 4)."""

from __future__ import annotations

import dataclasses

from jaxtyping import Bool
from torch import Tensor

from primdiffusion.editing.edit import check_correspondence, combine, with_edit
from primdiffusion.editing.regions import check_region, name_region
from primdiffusion.human import Human
from primdiffusion.primitives.primitives import Payload


def transfer_texture(source: Human, target: Human, region: Bool[Tensor, "k"]) -> Human:
    """Return the target with the source's colours in a region: the paper's exchange of corresponding primitives.

    Densities, delta scales and betas stay the target's. Suits garments of the same cut, skin, hair colour and patterns.
    Exact and model-free.

        >>> dressed = pd.transfer_texture(varied, human, region)
        >>> dressed.payload.rgb[region].equal(varied.payload.rgb[region])
        True

    Raises ValueError for a region that is empty or not a mask of K, and for different bodies.
    """
    payload = dataclasses.replace(target.payload, rgb=source.payload.rgb)
    return _transferred("transfer_texture", source, target, region, payload)


def transfer_garment(source: Human, target: Human, region: Bool[Tensor, "k"]) -> Human:
    """Return the target with the source's colours, densities and delta scales in a region.

    Suits different cuts, such as a coat over a shirt or long hair, because the silhouette changes too. The target's
    betas stay. The border of the region may be visible; `harmonise` smooths it.

        >>> dressed = pd.transfer_garment(varied, human, region)
        >>> dressed.payload.density[region].equal(varied.payload.density[region])
        True

    Raises as `transfer_texture`.
    """
    return _transferred("transfer_garment", source, target, region, source.payload)


def _transferred(name: str, source: Human, target: Human, region: Tensor, payload: Payload) -> Human:
    region = check_region(region)
    check_correspondence("the source", source.body_setup, "the target", target.body_setup)
    edit = {"edit": name, "region": name_region(region, target.body_setup), "source": dict(source.provenance)}
    return with_edit(target, edit, combine(region, payload, target.payload))
