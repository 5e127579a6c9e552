"""The child that tests start instead of the backend, and seeds by which it is told to misbehave."""

import json
from pathlib import Path

from support import tensor_files

FAKE_CHILD = Path(__file__).with_name("child")
"""The folder of its package `primdiffusion`."""
_SEEDS = json.loads((FAKE_CHILD / "primdiffusion" / "seeds.json").read_text())
DIES, FAILS, GIVES_GARBAGE, TAKES_LONG = (_SEEDS[name] for name in ("dies", "fails", "gives garbage", "takes long"))
IGNORES_CANCEL, NO_MEMORY = _SEEDS["ignores cancel"], _SEEDS["no memory"]


def request_of(person: Path) -> dict:
    """The parameters of the request that made a human's file."""
    return json.loads(tensor_files.read_tensors(person)[1]["asked"])
