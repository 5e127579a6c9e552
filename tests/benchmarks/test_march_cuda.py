"""The benchmark of CUDA devices, rehearsed without one: in Triton's interpreter, on small scenes, without a clock.

Time on such a device is short, so the script must not fail there for a name that has changed here.
"""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FIGURES = (
    "cuda_forward_512_ms", "cuda_forward_256_ms", "cuda_forward_1mm_ms", "cuda_forward_16_people_ms",
    "cuda_training_ms", "cuda_training_released_ms", "cuda_launch_share", "cuda_gradient_cosine_min",
    "cuda_train_step_ms", "cuda_train_step_eager_of_2_ms", "cuda_train_weights_apart_of_2",
)  # fmt: skip
REHEARSAL = """
import functools, subprocess, sys
from dataclasses import replace
import march_cuda, pytest, torch, train_cuda
from march_scenes import random_boxes
from support import graphs

def clock(call, *_):
    call()
    return 1.0

patch = pytest.MonkeyPatch()
graphs.on_processors(patch)
boxes = random_boxes(1, spread=0.01, smallest=0.3, largest=0.4, density=4.0)
torch.save({"person": dict(vars(boxes)), "samples": dict.fromkeys((0.2, 0.05), 100)}, "person.pt")
small, whole = march_cuda.portrait(4), subprocess.run
for module, name, value in (
    (torch.cuda, "is_available", lambda asked=[True]: bool(asked) and asked.pop()),  # by the script, not by accelerate
    (torch.cuda, "synchronize", lambda: None),
    (march_cuda, "DEVICE", "cpu"),
    (march_cuda, "portrait", lambda size: small),
    (march_cuda, "DEFAULT", replace(march_cuda.DEFAULT, step=0.2)),
    (march_cuda, "FINE", replace(march_cuda.FINE, step=0.05)),
    (march_cuda, "RELEASED", replace(march_cuda.RELEASED, step=0.2)),
    (march_cuda, "median_ms", clock),
    (march_cuda, "kernels_ms", lambda call: (0.5 * clock(call), "a table")),
    (march_cuda, "operations_per_second", lambda: 1e12),
    (march_cuda, "copied_bytes_per_second", lambda: 1e12),
    (march_cuda, "cached_bytes_per_second", lambda: 1e12),
    (train_cuda, "median_ms", clock),
    (train_cuda, "BATCHES", (2,)),
    (train_cuda, "STEPS", 2),
    (train_cuda, "Training", functools.partial(train_cuda.Training, people=16)),
    (subprocess, "run", lambda command, **how: whole([*command, "--collect-only"], **how)),
):
    patch.setattr(module, name, value)
sys.argv = ["march_cuda.py", "--train", "--cases", "--kernels", "--person", "person.pt", "--json", "figures.json"]
march_cuda.main()
"""


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="triton is not installed")
def test_the_benchmark_of_cuda_devices_runs_through_and_records_every_figure(tmp_path):
    folders = [ROOT / name for name in ("benchmarks", "tests/backend", "tests", "backend")]
    environment = os.environ | {"TRITON_INTERPRET": "1", "PYTHONPATH": os.pathsep.join(map(str, folders))}
    command = [sys.executable, "-c", REHEARSAL]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    found = json.loads((tmp_path / "figures.json").read_text())
    assert [name for name in FIGURES if found.get(name) is None] == []
    assert all(value for name, value in found.items() if name.startswith("cuda_graph_same_bits"))
    assert found["cuda_cases_pass"]
    assert found["cuda_gradient_cosine_min"] > 0.999
    assert found["cuda_train_weights_apart_of_2"] == 0
