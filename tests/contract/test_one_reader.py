"""Untrusted files are read, and files removed, by the modules made for it alone."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
BACKEND, EXTENSION = ROOT / "backend" / "primdiffusion", ROOT / "blender_primdiffusion"
ALLOWED = {
    "zipfile": {"files/arrays.py", "files/torch_file.py"},
    "numpy.load": {"files/arrays.py"},
    "numpy.lib.format.read_array": set(),
    "json.load": set(),
    "json.loads": {"files/json_files.py"},
    "pickle": {"files/torch_file.py", "files/smpl_pickle.py"},  # after a scan of its operations
    "torch.load": {"files/torch_file.py"},
    "safetensors.safe_open": {"files/tensor_file.py"},
    "safetensors.torch.load_file": set(),
    "safetensors.torch.save": {"files/tensor_file.py"},
    "safetensors.torch.save_file": set(),
    "load_state_dict": {
        "files/tensor_file.py",  # within the room for what the file holds
        "diffusion/checkpoint.py",  # the same, without memory of its own
        "evaluation/pretrained_networks.py",  # of a size that no file states
        "released/imported.py",
        "training/muon.py",  # of an optimiser
        "training/state.py",
    },
    "PIL.Image.open": {"geometry/pictures.py"},
    "shutil.rmtree": {"files/regular_files.py", "capture/__main__.py"},  # launch: Blender's own folder
    "unlink": {"files/regular_files.py"},
    "os.unlink": {"backend/child_process.py"},  # a temporary file while it is open
    "os.remove": set(),
    "read_text": {"files/whole_files.py", "backend/packages.py", "runtime/machine.py"},  # facts about the machine
    "read_bytes": set(),
    "resolve": set(),  # raises RuntimeError for links in a circle: `real_path` does not
    "open": {
        "files/regular_files.py",
        "backend/child_process.py",
        "capture/coco.py",
        "capture/dataset.py",
        "evaluation/gallery.py",
        "files/picture_files.py",
        "formats/poses/files.py",
        "scene/human_file.py",
        "backend/packages.py",
        "jobs/remedies.py",
        "cli.py",
    },  # of what this program writes, or has written itself
}
"""What only some modules may call or import."""
_METHODS = ("read_text", "read_bytes", "load_state_dict")
_SHORT = {"np": "numpy", "Image": "PIL.Image"}


def dotted(node: ast.AST) -> str:
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value)}.{node.attr}"
    return _SHORT.get(node.id, node.id) if isinstance(node, ast.Name) else ""


def _opens_a_path(call: ast.Call) -> bool:
    mode = call.args[0] if call.args else None
    is_mode = isinstance(mode, ast.Constant) and re.fullmatch("[rwxabt+]{1,3}", str(mode.value))
    return isinstance(call.func, ast.Attribute) and call.func.attr == "open" and bool(is_mode)


def used(tree: ast.AST) -> Iterator[str]:
    """Names of `ALLOWED` that a module imports or calls."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield str(node.module)
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Call):
            yield dotted(node.func)
            if isinstance(node.func, ast.Attribute) and node.func.attr == "unlink" and not node.args:
                yield "unlink"  # of a path: Blender's collections unlink an argument
            if isinstance(node.func, ast.Attribute) and node.func.attr in _METHODS:
                yield node.func.attr
            if re.fullmatch(r"(\w+\.)+resolve", dotted(node.func)):
                yield "resolve"  # not Path(__file__).resolve()
            if dotted(node.func) == "open" or _opens_a_path(node):
                yield "open"


@pytest.mark.parametrize("root", [BACKEND, EXTENSION], ids=["backend", "extension"])
def test_only_the_readers_open_archives_and_only_the_remover_removes(root):
    found = {
        (name, path.relative_to(root).as_posix())
        for path in root.rglob("*.py")
        for name in used(ast.parse(path.read_text(encoding="utf-8")))
        if name in ALLOWED and path.relative_to(root).as_posix() not in ALLOWED[name]
    }
    assert not found


@pytest.mark.parametrize(
    "line",
    ["import zipfile", "np.load(x)", "json.load(file)", "json.loads(text)", "from json import loads", "import pickle",
     "from safetensors import safe_open",
     "open(path)", "path.open('rb')", "path.read_text()", "path.read_bytes()",
     "network.load_state_dict(tensors)",
     "path.parent.resolve()",
     "shutil.rmtree(path)", "path.unlink()", "path.unlink(missing_ok=True)", "os.remove(path)", "Image.open(path)"],
)  # fmt: skip
def test_the_rule_sees(line):
    assert set(used(ast.parse(line))) & set(ALLOWED)
