"""A page in the browser: choose attributes and a seed, see the human from all sides, download .human and GLB files.

pip install "primdiffusion" "gradio>=5"
python examples/app.py                  # prints an address on this machine
"""

import argparse
import tempfile
from pathlib import Path

import gradio
import primdiffusion as pd
from PIL import Image
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.export.proxy import mesh_proxy, write_proxy_glb
from primdiffusion.human_file import save_human

VIEWS = 24
ANY = "any"


def turntable(human: pd.Human, folder: Path, size: int) -> Path:
    """Write an animation of one turn."""
    boxes = pd.place(human)
    pictures = []
    for view in range(VIEWS):
        camera = pd.framing(boxes, 360 * view / VIEWS, size, size)
        path = folder / f"{view:02d}.png"
        pd.march(boxes, camera).save(path, background=(0.8, 0.8, 0.8))
        pictures.append(Image.open(path))
    pictures[0].save(folder / "turntable.webp", save_all=True, append_images=pictures[1:], duration=1000 // 12, loop=0)
    return folder / "turntable.webp"


def page(model: DiffusionModel, size: int = 384) -> gradio.Blocks:
    """The page; `launch` serves it."""
    names = list(model.vocabulary.categories)

    def generate(seed: float, *values: str) -> tuple[str, str, str]:
        attributes = {name: value for name, value in zip(names, values, strict=True) if value != ANY}
        folder = Path(tempfile.mkdtemp(prefix="primdiffusion_"))
        human = pd.generate(model, int(seed), attributes=attributes)
        save_human(folder / "person.human.safetensors", human, compact=True)
        write_proxy_glb(folder / "person.glb", mesh_proxy(human), human.provenance)
        return tuple(
            map(str, (turntable(human, folder, size), folder / "person.human.safetensors", folder / "person.glb"))
        )

    with gradio.Blocks(title="PrimDiffusion") as blocks, gradio.Row():
        with gradio.Column(scale=1):
            choices = [
                gradio.Dropdown([ANY, *model.vocabulary.categories[name]], value=ANY, label=name) for name in names
            ]
            seed = gradio.Number(7, label="seed", precision=0, minimum=0)
            button = gradio.Button("Generate Human", variant="primary")
        with gradio.Column(scale=2):
            picture = gradio.Image(label="turntable", format="webp", type="filepath")
            files = [gradio.File(label=label) for label in ("human", "GLB")]
        button.click(generate, [seed, *choices], [picture, *files])
    return blocks


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoint", type=Path)
    model = pd.load_checkpoint(parser.parse_args().checkpoint)
    page(model).launch(server_name="127.0.0.1", share=False)  # whatever GRADIO_SERVER_NAME and GRADIO_SHARE say
