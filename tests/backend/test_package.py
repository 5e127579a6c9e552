"""`import primdiffusion` is enough for a first script, and loads torch when it is needed."""

import subprocess
import sys

import primdiffusion as pd
import pytest
from PIL import Image
from tiny_model import save_tiny_checkpoint


def test_the_names_of_a_first_script_are_there(tmp_path):
    model = pd.load_checkpoint(save_tiny_checkpoint(tmp_path / "tiny.safetensors"))
    human = pd.generate(model, seed=7, steps=2)
    boxes = pd.place(human)
    image = pd.march(boxes, pd.framing(boxes, yaw_degrees=30, width=24, height=32))
    assert image.rgb.shape == (32, 24, 3)
    image.save(tmp_path / "person.png")
    with Image.open(tmp_path / "person.png") as saved:
        assert (saved.mode, saved.size) == ("RGBA", (24, 32))
    assert (type(human), type(boxes)) == (pd.Human, pd.Primitives)
    assert set(pd.__all__) <= set(dir(pd))


def test_torch_is_loaded_with_the_first_name_that_is_used():
    script = (
        "import sys, primdiffusion as pd; assert 'torch' not in sys.modules; pd.Camera; assert 'torch' in sys.modules"
    )
    subprocess.run([sys.executable, "-c", script], check=True, timeout=500)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="nothing"):
        pd.nothing  # noqa: B018
