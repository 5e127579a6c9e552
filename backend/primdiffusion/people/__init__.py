"""Generate dressed, rigged humans from MakeHuman assets: the training data."""

from primdiffusion.people.assets import Assets, open_assets
from primdiffusion.people.base_mesh import BaseMesh, load_base_mesh
from primdiffusion.people.person import Person, make_person, recolour

__all__ = [
    "Assets",
    "BaseMesh",
    "Person",
    "load_base_mesh",
    "make_person",
    "open_assets",
    "recolour",
]
