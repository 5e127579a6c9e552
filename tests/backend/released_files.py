"""A checkpoint with the names and shapes of the authors', and a body in SMPL's format, made of numbers of our own."""

import pickle
from pathlib import Path

import numpy as np
import scipy.sparse
import torch
from primdiffusion.diffusion.unet import SlabUNet, UNetConfig
from torch import Tensor

T = 1000
SMALL = UNetConfig(width=32)
"""298 tensors as released, at a quarter of the width."""
TINY = UNetConfig(width=32, multipliers=(1, 1, 1, 1), blocks=1)
"""Thinner still, for whole slabs in seconds."""
SEGMENTS, RINGS, HEIGHT, RADIUS = 24, 13, 1.6, 0.2
PARENTS = [2**32 - 1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21]


def schedule_buffers() -> dict[str, Tensor]:
    """As a DDPM saves them: written out with numpy, then float32."""
    betas = np.linspace(1e-4**0.5, 2e-2**0.5, T) ** 2
    alphas = 1 - betas
    bar = np.cumprod(alphas)
    before = np.append(1.0, bar[:-1])
    variance = betas * (1 - before) / (1 - bar)
    arrays = {
        "betas": betas,
        "alphas_cumprod": bar,
        "alphas_cumprod_prev": before,
        "sqrt_alphas_cumprod": np.sqrt(bar),
        "sqrt_one_minus_alphas_cumprod": np.sqrt(1 - bar),
        "log_one_minus_alphas_cumprod": np.log(1 - bar),
        "sqrt_recip_alphas_cumprod": np.sqrt(1 / bar),
        "sqrt_recipm1_alphas_cumprod": np.sqrt(1 / bar - 1),
        "posterior_variance": variance,
        "posterior_log_variance_clipped": np.log(np.maximum(variance, 1e-20)),
        "posterior_mean_coef1": betas * np.sqrt(before) / (1 - bar),
        "posterior_mean_coef2": (1 - before) * np.sqrt(alphas) / (1 - bar),
    }
    return {name: torch.from_numpy(array).float() for name, array in arrays.items()}


def convolution(name: str, weight: tuple[int, ...], bias: tuple[int, ...]) -> dict[str, Tensor]:
    return {f"{name}.weight": blank(*weight), f"{name}.bias": blank(*bias), f"{name}.g": blank(bias[0])}


def blank(*shape: int) -> Tensor:
    """Ones of any shape that take no memory."""
    return torch.ones(()).expand(shape)


def stage_one(template: Tensor) -> dict[str, Tensor]:
    """The 165 tensors by SPEC 2 and 6; names within the groups are ours."""
    found: dict[str, Tensor] = {"lbs_fn.template": template[None]}
    found |= {f"lbs_fn.part{i}": blank(3) for i in range(6)} | {f"geo_fn.part{i}": blank(3) for i in range(7)}
    for group, i, o, k in (("local_pose_conv_block", 69, 32, 1), ("joint_conv_block", 96, 64, 3)):
        found |= convolution(f"{group}.conv1", (i, i, k, k), (i, 32, 32))
        found |= convolution(f"{group}.conv2", (o, i, k, k), (o, 32, 32))
        found |= convolution(f"{group}.conv_resize", (o, i, 1, 1), (o,))
    sides = [(3, 4, 128), (4, 8, 64), (8, 16, 32), (16, 8, 16), (8, 16, 8), (16, 32, 4), (32, 64, 2), (64, 128, 1)]
    for n, (i, o, side) in enumerate(sides):
        found |= convolution(f"embs_encoder.down.{n}", (o, i, 4, 4), (o, side, side))
    for n, (i, o, side) in enumerate([(128, 64, 2), (64, 32, 4), (32, 16, 8), (16, 8, 16), (8, 8, 32)]):
        found |= convolution(f"embs_encoder.up.{n}", (i, o, 4, 4), (o, side, side))
    found |= convolution("embs_encoder.out", (64, 24, 1, 1), (64, 32, 32))
    for n, (i, o) in enumerate([(64, 64), (64, 128), (128, 64), (64, 64), (64, 9)]):
        found |= convolution(f"decoder_motion.{n}", (o, i, 3, 3), (o, 32, 32))
    for group, last in (("decoder_rgb", 24), ("decoder_alpha", 8)):
        for n, (i, o, side) in enumerate([(64, 32, 64), (32, 16, 128), (16, last, 256)]):
            found |= convolution(f"{group}.{n}", (i, o, 4, 4), (o, side, side))
    for n in range(4):
        found |= convolution(f"decoder_geom.{n}", (5, 5, 3, 3), (5, 7, 7))
    return found | {f"transformer.{name}": blank(*shape) for name, shape in attention().items()}


def random_stage_one(template: Tensor, seed: int = 0) -> dict[str, Tensor]:
    """`stage_one` with weights that keep the size of the signal, so that colours and densities are within range."""
    generator = torch.Generator().manual_seed(seed)
    found = stage_one(template)
    for name, value in found.items():
        group, kind = name.partition(".")[0], name.rpartition(".")[2]
        if group in ("lbs_fn", "geo_fn", "decoder_geom"):
            continue
        draw = torch.randn(value.shape, generator=generator)
        if kind == "g":
            up = group in ("decoder_rgb", "decoder_alpha") or ".up." in name
            draw = (2 if up else 1) * value.numel() ** 0.5 * (1 + 0.2 * draw)
        elif group != "transformer":
            draw = draw if kind == "weight" else 0.3 * draw
        elif value.ndim == 1:
            draw = 0.1 * draw + float(kind == "weight")
        else:
            draw = draw / value[0].numel() ** 0.5
        found[name] = draw
    return found


def attention() -> dict[str, tuple[int, ...]]:
    shapes: dict[str, tuple[int, ...]] = {
        "norm.weight": (96,), "norm.bias": (96,), "proj_in.weight": (256, 96, 1, 1), "proj_in.bias": (256,),
        "proj_out.weight": (96, 256, 1, 1), "proj_out.bias": (96,),
    }  # fmt: skip
    for block in (f"transformer_blocks.{n}" for n in range(2)):
        for name in ("attn1", "attn2"):
            shapes |= {f"{block}.{name}.to_{part}.weight": (256, 256) for part in "qkv"}
            shapes |= {f"{block}.{name}.to_out.0.weight": (256, 256), f"{block}.{name}.to_out.0.bias": (256,)}
        shapes |= {f"{block}.ff.net.0.proj.weight": (2048, 256), f"{block}.ff.net.0.proj.bias": (2048,)}
        shapes |= {f"{block}.ff.net.2.weight": (256, 1024), f"{block}.ff.net.2.bias": (256,)}
        shapes |= {f"{block}.norm{n}.{part}": (256,) for n in (1, 2, 3) for part in ("weight", "bias")}
    return shapes


def random_network(config: UNetConfig, seed: int = 0) -> SlabUNet:
    """With weights as after some training: none is zero."""
    torch.manual_seed(seed)
    network = SlabUNet(config)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.02 * torch.randn(parameter.shape))
    return network.eval()


def state(denoiser: dict[str, Tensor], template: Tensor, stage: dict[str, Tensor] | None = None) -> dict[str, Tensor]:
    """What the authors' file has under "model_state_dict"; `stage` is `stage_one` if None."""
    stage = stage_one(template) if stage is None else stage
    return (
        schedule_buffers()
        | {f"bodydecoder.{name}": value for name, value in stage.items()}
        | {f"diffusion.{name}": value for name, value in denoiser.items()}
    )


def save_released(path: Path, tensors: dict[str, Tensor]) -> Path:
    """As the released code saves: weights and an optimiser."""
    optimizer = {"state": {0: {"step": 3, "exp_avg": torch.zeros(4)}}, "param_groups": [{"lr": 1e-5, "params": [0]}]}
    torch.save({"model_state_dict": tensors, "optimizer": optimizer}, path)
    return path


def body_arrays() -> dict[str, object]:
    """A closed drum of a body, 1.6 m high, whose upper half is moved by the neck; betas make it wider."""
    ring, step = np.divmod(np.arange(RINGS * SEGMENTS), SEGMENTS)
    angle = 2 * np.pi * step / SEGMENTS
    height = HEIGHT * ring / (RINGS - 1) - HEIGHT / 2
    template = np.stack([RADIUS * np.sin(angle), height, RADIUS * np.cos(angle)], 1)
    template = np.concatenate([template, [[0, -HEIGHT / 2, 0], [0, HEIGHT / 2, 0]]])
    count = len(template)
    weights = np.zeros((count, 24))
    weights[:, 0] = template[:, 1] <= 0
    weights[:, 12] = template[:, 1] > 0
    shapes = np.zeros((count, 3, 10))
    shapes[:, [0, 2], 0] = 0.1 * template[:, [0, 2]]
    regressor = np.zeros((24, count))
    regressor[:, -2:] = 0.5
    return {
        "v_template": template,
        "f": _faces()[0].astype(np.uint32),
        "shapedirs": shapes,
        "posedirs": np.zeros((count, 3, 207)),
        "weights": weights,
        "J_regressor": scipy.sparse.csc_matrix(regressor),
        "kintree_table": np.array([PARENTS, range(24)], np.int64),
        "bs_style": "lbs",
    }


def _faces() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Faces, texture coordinates and their faces; the charts leave the right quarter of the square free."""
    faces, uv_faces = [], []
    columns = SEGMENTS + 1
    for ring in range(RINGS - 1):
        for step in range(SEGMENTS):
            a, b = ring * SEGMENTS + step, ring * SEGMENTS + (step + 1) % SEGMENTS
            c, d = b + SEGMENTS, a + SEGMENTS
            p = ring * columns + step
            faces += [[a, b, c], [a, c, d]]
            uv_faces += [[p, p + 1, p + 1 + columns], [p, p + 1 + columns, p + columns]]
    u, v = np.meshgrid(np.linspace(0, 0.75, columns), np.linspace(0, 0.9, RINGS))
    uv = np.stack([u, v], -1).reshape(-1, 2)
    bottom, top = RINGS * SEGMENTS, RINGS * SEGMENTS + 1
    for step in range(SEGMENTS):
        after, last = (step + 1) % SEGMENTS, (RINGS - 1) * SEGMENTS
        for face in ([bottom, after, step], [top, last + step, last + after]):
            faces.append(face)
            n = len(uv)
            middle, height = 0.75 * (step + 0.5) / SEGMENTS, 0.92 if face[0] == bottom else 0.97
            uv = np.concatenate([uv, [[middle, height], [middle + 0.01, height], [middle, height + 0.02]]])
            uv_faces.append([n, n + 1, n + 2])
    return np.array(faces), uv, np.array(uv_faces)


def save_body(folder: Path) -> tuple[Path, Path]:
    """SMPL_NEUTRAL.pkl and its UV as an .obj."""
    arrays = body_arrays()
    faces, uv, uv_faces = _faces()
    smpl, obj = folder / "SMPL_NEUTRAL.pkl", folder / "smpl_uv.obj"
    smpl.write_bytes(pickle.dumps(arrays, 2))
    lines = [f"vt {u} {v}" for u, v in uv]
    lines += [
        "f " + " ".join(f"{a + 1}/{b + 1}" for a, b in zip(face, corners, strict=True))
        for face, corners in zip(faces, uv_faces, strict=True)
    ]
    obj.write_text("\n".join(lines) + "\n")
    return smpl, obj


def template() -> Tensor:
    return torch.from_numpy(np.asarray(body_arrays()["v_template"])).float()
