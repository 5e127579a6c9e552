"""The fast marcher for CUDA devices: Triton kernels, float32, batched, with a hand-written adjoint (SPEC 4).

The same rule as `reference.py`. Triton compiles the kernels on first use and caches them on disk. `scene` launches the
forward pass, and `marcher` repeats it as graphs.
"""

from __future__ import annotations

import functools
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from primdiffusion.geometry.camera import Camera
from primdiffusion.primitives.primitives import Primitives, S
from primdiffusion.render.cuda import graph as cuda_graph
from primdiffusion.render.cuda import scene as cuda_scene
from primdiffusion.render.cuda import triton_adjoint
from primdiffusion.render.cuda.marcher import prepared
from primdiffusion.render.cuda.scene import BOX_FIELDS, MarchScene, Packed, Picture, Shapes, check, launch
from primdiffusion.render.image import Rendering
from primdiffusion.render.lattice import MarchSettings, Span, check_scene

LANES_OF_SEEDS = 256
"""Rays per program of `seed_rays`."""


def march_cuda(
    primitives: Primitives,
    camera: Camera,
    settings: MarchSettings = MarchSettings(),  # noqa: B008
    span: Span | None = None,
    shapes: Shapes = Shapes(),  # noqa: B008
) -> Rendering:
    """Same as `march_reference`, in float32 on a CUDA device; images [B, H, W].

    `primitives` have one leading dimension, 1 or B (1: all views see the same boxes), `camera` and `span` B.
    Differentiable once in every tensor of primitives and camera. Images and gradients are deterministic. Voxel
    gradients are summed in tf32 (eleven significant bits per term). Waits for the device only until the boxes are
    placed, for checks, while the picture is being drawn (see `cuda_scene`). Without gradients and span, calls for as
    many boxes as an earlier one are launched as graphs, by a `Marcher` that stays in memory. Memory beyond inputs and
    outputs: 9 KB per box, and 20 bytes for each tile that a box touches, at most `LIST_LIMIT` of them; with gradients
    40 bytes per pixel, and during the backward pass another 32 per pixel and 8 KB for every 512 pixels of a box (for
    more pixels in larger images). In index order 40 bytes per pixel even without gradients, and lists twice.

    Raises ValueError as `check_scene` does, for voxels other than 8^3 and dtypes other than float32.
    """
    check(primitives, camera, span)
    tensors = [getattr(primitives, name) for name in BOX_FIELDS] + [camera.intrinsics, camera.world_to_camera]
    keep = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    device = primitives.position.device
    with cuda_scene.on_device(device):
        repeats = cuda_graph.usable(device) and not cuda_graph.recording() and span is None and not keep
        if repeats and primitives.position.shape[1] and (marcher := prepared(primitives, settings, shapes)):
            return marcher(camera)
        return Rendering(*_March.apply(MarchScene(primitives, camera, settings, span, shapes, keep), *tensors))


class _March(torch.autograd.Function):
    """Forward pass and adjoint (SPEC 4). The gradient of a sample depends on it and a few numbers of its ray."""

    @staticmethod
    def forward(ctx: Any, scene: MarchScene, *tensors: Tensor) -> Picture:
        *geometry, rgb, density, intrinsics, world_to_camera = [tensor.detach().contiguous() for tensor in tensors]
        (p, k), (b, height, width) = rgb.shape[:2], (len(intrinsics), scene.camera.height, scene.camera.width)
        if k == 0:
            check_scene(scene.primitives, scene.camera, scene.span)
            nothing = intrinsics.new_zeros((b, height, width))
            infinity = torch.full_like(nothing, torch.inf)
            ctx.units, ctx.nothing = None, [tensor.shape for tensor in tensors]
            picture = (nothing[..., None].expand(b, height, width, 3).clone(), nothing, infinity, infinity.clone())
            ctx.mark_non_differentiable(picture[3])
            return picture
        packed = Packed.room(p, k, rgb.device).pack(rgb, density)
        placed = cuda_scene.place(scene, packed, geometry, intrinsics, world_to_camera)
        picture = cuda_scene.new_picture(b, height, width, rgb.device)
        kept, ctx.units = cuda_scene.drawn(
            scene, placed, lambda plan: cuda_scene.draw(scene, packed, placed, picture, plan)
        )
        ctx.mark_non_differentiable(picture[3])
        ctx.shapes, ctx.spacing, ctx.index_order = scene.shapes, scene.spacing, scene.index_order
        if scene.keep:
            cameras, boxes = (intrinsics, world_to_camera), (placed.record, placed.indices, packed.voxels)
            ctx.save_for_backward(*geometry, *cameras, *boxes, placed.reach, *kept)
        return picture

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *on_picture: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        if ctx.units is None:
            return None, *(on_picture[0].new_zeros(shape) for shape in ctx.nothing)
        settings = (ctx.shapes, ctx.spacing, ctx.units, ctx.index_order, any(ctx.needs_input_grad[-2:]))
        return None, *_adjoint(*settings, *on_picture[:3], *ctx.saved_tensors)


def _adjoint(
    shapes: Shapes,
    spacing: float,
    units: int,
    index_order: bool,
    to_camera: bool,
    on_rgb: Tensor,
    on_alpha: Tensor,
    on_depth: Tensor,
    *saved: Tensor,
) -> tuple[Tensor | None, ...]:
    """Gradients in the order of `_March.forward`'s tensors; those of the camera if they go `to_camera`.

    `units` may be more than the boxes have, in a recording; where they are too few, the result is of no use, as every
    repetition of the recording looks for (see `cuda_scene.drawn`).
    """
    position, rotation, half_extent, intrinsics, world_to_camera, record, indices, voxels, reach, kept, ends = saved
    height, width = on_alpha.shape[1:]
    (p, k), b, device = position.shape[:2], len(intrinsics), position.device
    own_boxes = k if p == b else 0
    new = functools.partial(torch.empty, device=device)

    seeds = new((b, height, width, 8))
    rays = b * height * width
    launch(triton_adjoint.seed_rays, (-(-rays // LANES_OF_SEEDS),), 
        on_rgb.contiguous(), on_alpha.contiguous(), on_depth.contiguous(), kept, ends, seeds, rays, spacing,
        INDEX_ORDER=index_order, LANES=LANES_OF_SEEDS, num_warps=4,
    )  # fmt: skip
    blocks = indices[..., 12].flatten().long()
    blocks_of_unit = shapes.blocks_for(b * height * width)
    units_of_box = (blocks + blocks_of_unit - 1) // blocks_of_unit
    unit_end = units_of_box.cumsum(0)
    unit = torch.arange(units, device=device)
    # Units behind the last one count as parts of the last box, behind its last block: they are empty.
    unit_box = torch.searchsorted(unit_end, unit, right=True).clamp_max_(b * k - 1)
    unit_part = unit - (unit_end - units_of_box)[unit_box]
    unit_voxels, unit_sums = new((units, 64, 32)), new((units, triton_adjoint.SUMS))
    if units:
        launch(triton_adjoint.adjoint_boxes, (units,), 
            record, indices, voxels, reach, seeds, ends, unit_box, unit_part, rotation, half_extent, intrinsics,
            world_to_camera, unit_voxels, unit_sums, k, own_boxes, height, width, blocks_of_unit,
            spacing, HAS_SPAN=reach is not None, INDEX_ORDER=index_order, BLOCK_WIDTH=shapes.block[0],
            BLOCK_HEIGHT=shapes.block[1], num_warps=shapes.adjoint_warps,
        )  # fmt: skip
    on_boxes = [new(shape) for shape in ((p, k, 3), (p, k, 3, 3), (p, k, 3), (p, k, 3, S, S, S), (p, k, S, S, S))]
    on_camera = new((b, k, 12))
    launch(
        triton_adjoint.finish_boxes,
        (k, p),
        unit_end.clamp_max_(units),
        unit_voxels,
        unit_sums,
        rotation,
        half_extent,
        *on_boxes,
        on_camera,
        b // p,
        k,
        own_boxes,
        num_warps=4,
    )
    if not to_camera:
        return *on_boxes, None, None
    return *on_boxes, *_camera_gradient(on_camera.sum(1).double(), intrinsics.double(), world_to_camera.double())


def _camera_gradient(
    sums: Float[Tensor, "b 12"], intrinsics: Float[Tensor, "b 3 3"], world_to_camera: Float[Tensor, "b 3 4"]
) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3 4"]]:
    """From dL/do and sum dc v^T (see `triton_adjoint`), with o = -R_c^T t, m = R_c^T dc, dc = K^-1 [u, v, 1]."""
    on_origin, on_rotation = sums[:, :3], sums[:, 3:].unflatten(1, (3, 3))
    rotation, translation = world_to_camera[..., :3], world_to_camera[..., 3]
    # sum dL/dx [x, y, 1] and the same of y, for dc = [x, y, 1].
    on_dc = torch.einsum("bij,bkj->bik", rotation[:, :2], on_rotation)
    fx, skew, fy = intrinsics[:, 0, 0], intrinsics[:, 0, 1], intrinsics[:, 1, 1]
    on_x = -on_dc[:, 0] / fx[:, None]
    on_y = -(on_dc[:, 1] + skew[:, None] * on_x) / fy[:, None]
    zero = torch.zeros_like(fx)
    on_lens = [on_x[:, 0], on_x[:, 1], on_x[:, 2], zero, on_y[:, 1], on_y[:, 2], zero, zero, zero]
    on_rotation = on_rotation - translation[:, :, None] * on_origin[:, None, :]
    on_translation = -(rotation @ on_origin[..., None])
    gradients = torch.stack(on_lens, -1).unflatten(-1, (3, 3)), torch.cat([on_rotation, on_translation], -1)
    return gradients[0].float(), gradients[1].float()
