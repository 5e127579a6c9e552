"""The child that tests start instead of the backend, and seeds by which it is told to misbehave."""

import json
from pathlib import Path

FAKE_CHILD = Path(__file__).with_name("child")
"""The folder of its package `primdiffusion`."""
PICTURE = FAKE_CHILD / "primdiffusion" / "picture.png"
_SEEDS = json.loads((FAKE_CHILD / "primdiffusion" / "seeds.json").read_text())
DIES, FAILS, GIVES_GARBAGE, TAKES_LONG = (_SEEDS[name] for name in ("dies", "fails", "gives garbage", "takes long"))
IGNORES_CANCEL, NO_MEMORY = _SEEDS["ignores cancel"], _SEEDS["no memory"]
