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


def test_sizes_are_sums_over_rooms(tree):
    figures = house.sizes(tree({"ours/cli.py": "a = 1\n", "ours/render/march.py": "a = 1\n\nb = 2\n"}))
    assert figures == {
        "product_lines": 4, "product_files": 2, "backend_lines": 4, "backend_files": 2,
        "backend_render_lines": 3, "backend_render_files": 1, "backend_top_lines": 1, "backend_top_files": 1,
    }  # fmt: skip


@pytest.mark.parametrize(
    "back",
    ["from .a import f", "from . import a", "import ours.a", "def g():\n    from ours.a import f",
     "if TYPE_CHECKING:\n    from .a import f", "def g():\n    import_module('ours.a').f()"],
)  # fmt: skip
def test_a_circle_is_found_wherever_the_import_stands(tree, back):
    modules = tree({"ours/a.py": "from .b import g", "ours/b.py": back, "ours/c.py": "from . import a, b"})
    assert house.import_circles(modules) == ["ours.a <-> ours.b"]


def test_a_chain_is_no_circle(tree):
    assert house.import_circles(tree({"ours/a.py": "from .b import g", "ours/b.py": "from .c import h"})) == []


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


def test_threads_count_in_the_extension_alone(tree):
    source = "def f():\n    from concurrent.futures import Future\n"
    assert house.threads_in_extension(tree({"ours/a.py": source, "theirs/ui/a.py": source})) == ["theirs/ui/a.py"]


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


def test_a_test_is_found_by_the_path_of_its_source(tree):
    tree({"ours/render/march.py": "", "tests/render/test_march.py": "", "tests/render/test_march_gradients.py": "",
          "tests/test_march.py": "", "tests/render/test_marching.py": "", "tests/test_render.py": ""})  # fmt: skip
    assert house.tests_without_source() == ["tests/render/test_marching.py", "tests/test_march.py"]
