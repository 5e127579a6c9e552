"""The humans of the viewer's gallery, from names and seeds."""

import importlib.util
from pathlib import Path

from primdiffusion.human_file import load_human
from support.errors import refused
from support.tiny import save_tiny_checkpoint

SPEC = importlib.util.spec_from_file_location("make_gallery", Path(__file__).parents[2] / "scripts" / "make_gallery.py")
assert SPEC is not None
assert SPEC.loader is not None
make_gallery = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(make_gallery)


def test_each_human_is_a_compact_file_of_their_name(tmp_path):
    checkpoint = save_tiny_checkpoint(tmp_path / "tiny.safetensors")
    make_gallery.main(["--out", str(tmp_path / "gallery"), "--steps", "2", "--checkpoint", str(checkpoint), "Ada L=7"])
    (path,) = (tmp_path / "gallery").iterdir()
    assert path.name == "Ada_L.human"
    assert path.stat().st_size < 2.2e6
    assert load_human(path).provenance["seed"] == 7


def test_names_seeds_and_attributes_are_parsed():
    assert make_gallery.wanted("Ben=8,sex=male,height=1.9") == ("Ben", 8, {"sex": "male", "height": 1.9})
    with refused(ValueError, "NAME", "SEED"):
        make_gallery.wanted("Ben")
