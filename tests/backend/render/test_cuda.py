"""The fast marcher for CUDA devices: its cases interpreted and on a device, and what the compiler makes of its kernels.

The interpreter must be chosen before Triton is imported, so the cases (`march_cuda_cases.py`) run in processes of their
own.
"""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from march_scenes import camera_at, random_boxes
from primdiffusion.render import cuda
from primdiffusion.render.lattice import RELEASED, MarchSettings

CASES = Path(__file__).parents[1] / "march_cuda_cases.py"
HOPPER = 90
POINTER = {"f": "*fp32", "i": "*i32", "l": "*i64", "d": "*fp64"}
with_triton = pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="triton is not installed")


def run_cases(chosen: str, **environment: str) -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-k", chosen, str(CASES)]
    done = subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
    assert " passed" in done.stdout


@with_triton
@pytest.mark.parametrize(
    "chosen", ["overlapping or inside_boxes or one_pixel", pytest.param("", marks=pytest.mark.slow)]
)
def test_the_kernels_do_what_the_reference_does_in_the_interpreter(chosen):
    run_cases(chosen, TRITON_INTERPRET="1")


@with_triton
@pytest.mark.gpu
def test_the_kernels_do_what_the_reference_does_on_a_device():
    assert cuda.available("cuda")
    run_cases("", TRITON_INTERPRET="0")


def test_loads_without_triton_and_says_what_is_missing():
    script = (
        "import sys; sys.modules['triton'] = None\n"
        "import importlib.util; find = importlib.util.find_spec\n"
        "importlib.util.find_spec = lambda name, *rest: None if name == 'triton' else find(name, *rest)\n"
        "import torch; from primdiffusion.render import cuda\n"
        "from march_scenes import camera_at, random_boxes\n"
        "assert not cuda.available('cuda')\n"
        "boxes, camera = random_boxes(1).to(dtype=torch.float32), camera_at((0.0, 0.0, 0.5)).to(dtype=torch.float32)\n"
        "cuda.march_cuda(boxes.map(lambda t: t[None]), camera.map(lambda t: t[None]))\n"
    )
    path = os.pathsep.join([str(CASES.parent), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", script], env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True
    )
    assert "ImportError: march_cuda needs Triton, which is not installed" in done.stderr


def test_is_not_available_on_processors():
    assert not cuda.available(torch.device("cpu"))


def compile_for_hopper(kernel, pointers: str, scalars: tuple[str, ...], constants: dict, **options):
    """The kernel for sm_90 as it would be launched: tensors on 16-byte boundaries."""
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    types = iter([*(POINTER[letter] for letter in pointers), *scalars])
    signature = {name: "constexpr" if name in constants else next(types) for name in kernel.arg_names}
    assert next(types, None) is None
    names = list(signature)
    aligned = {(names.index(name),): [["tt.divisibility", 16]] for name, kind in signature.items() if kind[0] == "*"}
    source = ASTSource(kernel, signature, {(names.index(name),): value for name, value in constants.items()}, aligned)
    return triton.compile(source, target=GPUTarget("cuda", HOPPER, 32), options={"num_stages": 1, **options})


def resources(compiled, folder: Path) -> dict[str, int]:
    """Registers, stack (spilled registers lie there) and so on of a compiled kernel, by the tool that Triton brings."""
    import triton

    tool = Path(triton.__file__).parent / "backends/nvidia/bin/cuobjdump"
    if not tool.exists():
        pytest.skip(f"this build of triton has no {tool.name}")
    binary = folder / "kernel.cubin"
    binary.write_bytes(compiled.asm["cubin"])
    listing = subprocess.run([tool, "-res-usage", binary], capture_output=True, text=True, check=True)
    line = next(line for line in (listing.stdout + listing.stderr).splitlines() if "REG:" in line)
    return {name: int(value) for name, value in (part.split(":") for part in line.split() if part.count(":") == 1)}


@with_triton
@pytest.mark.parametrize(
    ("sets", "gap"), [(2, 2), *(pytest.param(*others, marks=pytest.mark.slow) for others in ((1, 4), (1, 1), (4, 1)))]
)
def test_the_forward_kernel_fits_into_registers(sets, gap, tmp_path):
    from primdiffusion.render import triton_march

    shapes = cuda.Shapes()
    constants = cuda.march_constants(shapes, sets, gap) | {
        "TILES_OF_LIST": 1, "HAS_SPAN": False, "KEEP": True, "WHOLE": True
    }  # fmt: skip
    compiled = compile_for_hopper(
        triton_march.march_tiles, "fifiliifffffi", ("i32",) * 7 + ("fp32",),
        constants, num_warps=shapes.march_warps, maxnreg=shapes.march_registers,
    )  # fmt: skip
    used = resources(compiled, tmp_path)
    assert used["STACK"] == 0
    assert used["REG"] <= shapes.march_registers
    assert "ld.global.v4" in compiled.asm["ptx"]


@with_triton
def test_the_backward_kernel_fits_into_registers_and_uses_tensor_cores(tmp_path):
    from primdiffusion.render import triton_adjoint

    shapes = cuda.Shapes()
    constants = {"HAS_SPAN": False, "BLOCK_WIDTH": shapes.block[0], "BLOCK_HEIGHT": shapes.block[1]}
    compiled = compile_for_hopper(
        triton_adjoint.adjoint_boxes, "fififillffffff", ("i32",) * 5 + ("fp32",),
        constants, num_warps=shapes.adjoint_warps,
    )  # fmt: skip
    assert resources(compiled, tmp_path)["STACK"] == 0
    assert "mma.sync" in compiled.asm["ptx"]
    assert "ld.global.v4" in compiled.asm["ptx"]


@pytest.mark.slow
@with_triton
def test_the_small_kernels_compile_without_spilling(tmp_path):
    """Also where an argument is 1 or absent: Triton compiles such kernels anew."""
    from primdiffusion.render import triton_adjoint, triton_boxes, triton_lists

    place = {"STRIDES": (4, 2, 1), "TILE_WIDTH": 8, "TILE_HEIGHT": 4, "BIN": 8}
    place |= {"BLOCK_WIDTH": 8, "BLOCK_HEIGHT": 4, "LANES": cuda.LANES}
    one = {"boxes": 1, "own_boxes": 1}
    lists = {"BIN": 8, "LANES": cuda.LANES_OF_TILE}
    kernels = [
        (triton_boxes.pack_boxes, "fffil", 0, {}, 4),
        (triton_boxes.place_boxes, "fffiffdfiil", 5, place, 1),
        (triton_lists.list_bins, "liilil", 2, lists, 4),
        (triton_lists.list_bins, "liilil", 0, lists | {"boxes": 1, "across": 1}, 4),
        (triton_adjoint.finish_boxes, "lffffffffff", 3, {}, 4),
        (triton_adjoint.finish_boxes, "lffffffffff", 0, one | {"views": 1}, 4),
    ]
    for kernel, pointers, scalars, constants, warps in kernels:
        compiled = compile_for_hopper(kernel, pointers, ("i32",) * scalars, constants, num_warps=warps)
        assert resources(compiled, tmp_path)["STACK"] == 0, kernel
    lists = lists | {"TILE_WIDTH": 8, "TILE_HEIGHT": 4}
    compiled = compile_for_hopper(
        triton_lists.list_tiles, "ilifiilil", ("i32",) * 4 + ("fp32",), lists, num_warps=1
    )  # fmt: skip
    assert resources(compiled, tmp_path)["STACK"] == 0
    compiled = compile_for_hopper(triton_adjoint.seed_rays, "ffffif", ("i32", "fp32"), {"LANES": 256}, num_warps=4)
    assert resources(compiled, tmp_path)["STACK"] == 0


def test_suits_what_it_can_draw():
    boxes, camera = random_boxes(1).to(dtype=torch.float32), camera_at((0.0, 0.0, 0.5)).to(dtype=torch.float32)
    assert cuda.suits(boxes, camera, MarchSettings())
    assert not cuda.suits(boxes, camera, RELEASED)
    assert not cuda.suits(boxes, camera.to(dtype=torch.float64), MarchSettings())
    assert not cuda.suits(random_boxes(1, size=4).to(dtype=torch.float32), camera, MarchSettings())
