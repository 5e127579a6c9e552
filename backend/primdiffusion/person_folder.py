"""The files of a generated person in a folder, the same from the command line and from Blender's child."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

from primdiffusion.human import Human, framing, place
from primdiffusion.human_file import export_for_blender, save_human
from primdiffusion.render.image import depth_to_png, to_png
from primdiffusion.render.march import march


@dataclasses.dataclass(frozen=True)
class PersonFiles:
    """File names in the folder."""

    blender: str = "human.npz"
    human: str = "person.human.safetensors"
    front: str = "front.png"
    side: str = "side.png"
    depth: str = "depth.png"

    def in_folder(self, folder: Path) -> dict[str, str]:
        """Their paths, by their names in results of requests."""
        names = {"human": self.blender, "person": self.human, "preview": self.front, "side": self.side}
        return {name: str(folder / file) for name, file in {**names, "depth": self.depth}.items()}


FILES = PersonFiles()


def write_person(folder: Path, human: Human, size: int) -> None:
    """Writes all of FILES: the person for Blender, the person to keep, and pictures in the T pose.

    The first picture on a machine takes some seconds longer: the marcher is compiled, and cached.
    """
    export_for_blender(folder / FILES.blender, human)
    save_human(folder / FILES.human, human)
    primitives = place(human)
    front = march(primitives, framing(primitives, 0.0, size, size))
    to_png(folder / FILES.front, front)
    depth_to_png(folder / FILES.depth, front)
    to_png(folder / FILES.side, march(primitives, framing(primitives, math.pi / 2, size, size)))
