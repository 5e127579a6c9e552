"""The fast marcher for CUDA devices: its cases interpreted and on a device, and what the compiler makes of its kernels.

The interpreter must be chosen before Triton is imported, so the cases (`march_cuda_cases.py`) run in processes of their
own.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from march_scenes import camera_at, random_boxes
from primdiffusion.render import cuda

pytest.importorskip("triton")
from primdiffusion.render.cuda import scene as cuda_scene
from support import hopper

CASES = Path(__file__).parents[2] / "march_cuda_cases.py"


def run_cases(chosen: str, **environment: str) -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-k", chosen, str(CASES)]
    done = subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
    assert " passed" in done.stdout


@pytest.mark.long
@pytest.mark.parametrize("chosen", [
    "(overlapping and (0-settings0 or 1-settings1)) or (inside_boxes and not position1) or 1-33",
    pytest.param("", marks=pytest.mark.slow),
])  # fmt: skip
def test_the_kernels_do_what_the_reference_does_in_the_interpreter(chosen):
    run_cases(chosen, TRITON_INTERPRET="1")


@pytest.mark.gpu
def test_the_kernels_do_what_the_reference_does_on_a_device():
    assert cuda.available("cuda")
    run_cases("", TRITON_INTERPRET="0")


def test_the_marcher_loads_without_triton():
    script = (
        "import sys; sys.modules['triton'] = None\n"
        "import importlib.util; find = importlib.util.find_spec\n"
        "importlib.util.find_spec = lambda name, *rest: None if name == 'triton' else find(name, *rest)\n"
        "import primdiffusion.render.march; from primdiffusion.render import cuda\n"
        "assert not cuda.available('cuda')\n"
    )
    path = os.pathsep.join([str(CASES.parent), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", script], env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def test_is_not_available_on_processors():
    assert not cuda.available(torch.device("cpu"))


def used(launch: hopper.Launch, folder: Path):
    """The compiled kernel, and its registers, stack and so on."""
    kernel = hopper.compiled(launch)
    found = hopper.resources(kernel, folder)
    if found is None:
        pytest.skip("this build of triton has no cuobjdump")
    return kernel, found


@pytest.mark.parametrize("index_order", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("sets", "gap"), [(2, 2), *(pytest.param(*others, marks=pytest.mark.slow) for others in ((1, 4), (1, 1), (4, 1)))]
)
def test_the_forward_kernel_fits_into_registers(sets, gap, index_order, tmp_path):
    kernel, found = used(hopper.forward(sets, gap, index_order=index_order), tmp_path)
    assert found["STACK"] == 0
    assert found["REG"] <= cuda_scene.Shapes().march_registers
    assert "ld.global.v4" in kernel.asm["ptx"]


@pytest.mark.parametrize("index_order", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_backward_kernel_fits_into_registers_and_uses_tensor_cores(index_order, tmp_path):
    kernel, found = used(hopper.backward(index_order=index_order), tmp_path)
    assert found["STACK"] == 0
    assert "mma.sync" in kernel.asm["ptx"]
    assert "ld.global.v4" in kernel.asm["ptx"]


@pytest.mark.slow
def test_the_small_kernels_compile_without_spilling(tmp_path):
    for launch in hopper.small():
        assert used(launch, tmp_path)[1]["STACK"] == 0, launch.kernel


def test_suits_what_it_can_draw():
    boxes, camera = random_boxes(1).to(dtype=torch.float32), camera_at((0.0, 0.0, 0.5)).to(dtype=torch.float32)
    assert cuda.supports(boxes, camera)
    assert not cuda.supports(boxes, camera.to(dtype=torch.float64))
    assert not cuda.supports(random_boxes(1, size=4).to(dtype=torch.float32), camera)
