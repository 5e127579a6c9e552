"""Shape annotations of the backend's maths are checked at run time in tests."""

from jaxtyping import install_import_hook
from primdiffusion.machine import share_processors

share_processors()

CHECKED = [
    f"primdiffusion.{module}"
    for module in (
        "geometry.rotation",
        "geometry.camera",
        "geometry.surface",
        "body.model",
        "body.skinning",
        "primitives.primitives",
        "primitives.anchors",
        "primitives.slab",
        "render.reference",
    )
]
install_import_hook(CHECKED, "beartype.beartype")
