"""Triton's kernels compiled for sm_90 (H100, H200) as they are launched, without such a device."""

import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from primdiffusion.render.cuda import march as cuda
from primdiffusion.render.cuda import scene as cuda_scene

HOPPER = 90
POINTER = {"f": "*fp32", "i": "*i32", "l": "*i64", "d": "*fp64"}


class Launch(NamedTuple):
    """A kernel and what it is launched with."""

    kernel: Any
    pointers: str
    """Types of the tensors, letters of POINTER."""
    scalars: tuple[str, ...]
    constants: Mapping[str, Any]
    options: Mapping[str, int]


def forward(sets: int, gap: int, *, index_order: bool = False) -> Launch:
    """The marcher's forward kernel, for this many sets of boxes and this gap."""
    from primdiffusion.render.cuda import triton_march

    shapes = cuda_scene.Shapes()
    more = {"TILES_OF_LIST": 1, "HAS_SPAN": False, "KEEP": True, "WHOLE": True, "INDEX_ORDER": index_order}
    constants = cuda_scene.march_constants(shapes, sets, gap) | more
    options = {"num_warps": shapes.march_warps, "maxnreg": shapes.march_registers}
    return Launch(triton_march.march_tiles, "fifiliifffffi", ("i32",) * 7 + ("fp32",), constants, options)


def backward(*, index_order: bool = False) -> Launch:
    """The marcher's backward kernel."""
    from primdiffusion.render.cuda import triton_adjoint

    shapes = cuda_scene.Shapes()
    constants = {"HAS_SPAN": False, "INDEX_ORDER": index_order}
    constants |= {"BLOCK_WIDTH": shapes.block[0], "BLOCK_HEIGHT": shapes.block[1]}
    options = {"num_warps": shapes.adjoint_warps}
    return Launch(triton_adjoint.adjoint_boxes, "fififillffffff", ("i32",) * 5 + ("fp32",), constants, options)


def small() -> Iterator[Launch]:
    """The others, also where an argument is 1 or absent: Triton compiles such kernels anew."""
    from primdiffusion.render.cuda import triton_adjoint, triton_boxes, triton_lists, triton_march

    place = {"STRIDES": (4, 2, 1), "TILE_WIDTH": 8, "TILE_HEIGHT": 4, "BIN": 8}
    place |= {"BLOCK_WIDTH": 8, "BLOCK_HEIGHT": 4, "LANES": cuda_scene.LANES}
    one = {"boxes": 1, "own_boxes": 1}
    lists = {"BIN": 8, "LANES": cuda_scene.LANES_OF_TILE}
    for kernel, pointers, scalars, constants, warps in (
        (triton_boxes.pack_boxes, "fffi", 0, {}, 4),
        (triton_boxes.place_boxes, "fffiffdfiil", 5, place, 1),
        (triton_lists.order_boxes, "ii", 1, {"LANES": cuda_scene.LANES, "CHUNK": cuda_scene.LANES_OF_ORDER}, 4),
        (triton_lists.list_bins, "iiilil", 3, lists, 4),
        (triton_lists.list_bins, "iiilil", 1, lists | {"boxes": 1, "across": 1}, 4),
        (triton_adjoint.finish_boxes, "lffffffffff", 3, {}, 4),
        (triton_adjoint.finish_boxes, "lffffffffff", 0, one | {"views": 1}, 4),
    ):
        yield Launch(kernel, pointers, ("i32",) * scalars, constants, {"num_warps": warps})
    tiles = {"TILE_WIDTH": 8, "TILE_HEIGHT": 4}
    end, end_of = triton_march.end_in_order, tiles | {"TILES_OF_LIST": 1}
    yield Launch(end, "fifiliffi", ("i32",) * 7 + ("fp32",), end_of, {"num_warps": 1})
    yield Launch(end, "fifiliffi", ("i32",) * 5 + ("fp32",), end_of | one, {"num_warps": 1})
    tiles |= lists
    yield Launch(triton_lists.list_tiles, "ilifiilil", ("i32",) * 5 + ("fp32",), tiles, {"num_warps": 1})
    for index_order in (False, True):
        constants = {"INDEX_ORDER": index_order, "LANES": cuda.LANES_OF_SEEDS}
        yield Launch(triton_adjoint.seed_rays, "ffffif", ("i32", "fp32"), constants, {"num_warps": 4})


def compiled(launch: Launch) -> Any:
    """The kernel as it would be launched: tensors on 16-byte boundaries."""
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    kernel, pointers, scalars, constants, options = launch
    types = iter([*(POINTER[letter] for letter in pointers), *scalars])
    signature = {name: "constexpr" if name in constants else next(types) for name in kernel.arg_names}
    assert next(types, None) is None
    names = list(signature)
    aligned = {(names.index(name),): [["tt.divisibility", 16]] for name, kind in signature.items() if kind[0] == "*"}
    source = ASTSource(kernel, signature, {(names.index(name),): value for name, value in constants.items()}, aligned)
    return triton.compile(source, target=GPUTarget("cuda", HOPPER, 32), options={"num_stages": 1, **options})


def resources(kernel: Any, folder: Path) -> dict[str, int] | None:
    """Registers, stack (spilled registers lie there) and so on of a compiled kernel, by the tool that Triton brings.

    None if this build of Triton has no such tool.
    """
    import triton

    tool = Path(triton.__file__).parent / "backends/nvidia/bin/cuobjdump"
    if not tool.exists():
        return None
    binary = folder / "kernel.cubin"
    binary.write_bytes(kernel.asm["cubin"])
    listing = subprocess.run([tool, "-res-usage", binary], capture_output=True, text=True, check=True, encoding="utf-8")
    line = next(line for line in (listing.stdout + listing.stderr).splitlines() if "REG:" in line)
    return {name: int(value) for name, value in (part.split(":") for part in line.split() if part.count(":") == 1)}
