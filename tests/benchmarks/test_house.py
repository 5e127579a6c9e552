"""The figures of the source tree count what they say, on trees small enough to count by hand."""

import house
import pytest


@pytest.fixture
def tree(tmp_path, monkeypatch):
    """Writes {path: source} and parses it as the backend `ours` and the extension `theirs`."""
    programs = {"backend": tmp_path / "ours", "extension": tmp_path / "theirs"}
    monkeypatch.setattr(house, "ROOT", tmp_path)
    monkeypatch.setattr(house, "PROGRAMS", programs)
    monkeypatch.setattr(house, "TESTS", {"backend": tmp_path / "tests"})

    def write(files: dict[str, str]) -> list[house.Module]:
        for name, source in files.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(source)
        return house.parsed()

    return write


@pytest.mark.parametrize(
    "back",
    ["from .a import f", "from . import a", "import ours.a", "def g():\n    from ours.a import f",
     "if TYPE_CHECKING:\n    from .a import f", "def g():\n    import_module('ours.a').f()"],
)  # fmt: skip
def test_a_circle_is_found_wherever_the_import_stands(tree, back):
    modules = tree({"ours/a.py": "from .b import g", "ours/b.py": back, "ours/c.py": "from . import a, b"})
    assert house.import_circles(modules) == ["ours.a <-> ours.b"]


@pytest.mark.parametrize(
    "body",
    [
        "import torch",
        "import torch  # loads for seconds",
        'import_module("torch")',
        "importlib.import_module(f'{a}.b')",
    ],
)
def test_an_import_in_a_function_is_hidden_whatever_a_comment_says(tree, body):
    found = house.hidden_imports(tree({"ours/a.py": f"import os\n\ndef f():\n    # late\n    {body}\n"}))
    assert len(found) == 1
    assert found[0].startswith("ours/a.py:5 ")


def test_a_public_class_name_in_two_modules_has_two_meanings(tree):
    both = "class Picture: ...\nclass _Own: ...\n"
    modules = tree({"ours/a.py": both, "theirs/b.py": both, "theirs/c.py": "class Other: ..."})
    assert house.names_with_two_meanings(modules) == ["Picture: ours.a, theirs.b"]


def test_a_record_of_pictures_has_their_colours(tree):
    source = """
class Image:
    rgb: Float32[ndarray, "h w 3"]
class Rendering:
    rgb: Float[Tensor, "*r 3"]
class Payload:
    rgb: Float[Tensor, "*k 3 8 8 8"]
class Part:
    texture: UInt8[ndarray, "H W 4"]
class _Own:
    rgba: UInt8[ndarray, "H W 4"]
"""
    found = house.picture_records(tree({"ours/a.py": source, "theirs/a.py": source}))
    assert found == ["ours.a.Image", "ours.a.Rendering"]
