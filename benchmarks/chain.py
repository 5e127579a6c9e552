"""Where detail of humans is lost between mesh and sample.

`python benchmarks/chain.py --assets DIR --held DIR --json F --sheet F.png` compares pictures of held-out people with
renders of their meshes (16 samples a pixel), all over grey, sRGB-encoded. Stages, each the prefix of its figures:

    mesh         the mesh at one sample a pixel: what aliasing alone costs
    from_mesh    `from_mesh`, through its storage in bytes
    payload      fitted to renders of the mesh, likewise
    codec_input  what the model learned from, at its own density: fitted, or from_mesh for older models
    codec        that after the model's codec
    step<t>      that after one denoising step from noise of level t

Views: `body` from the front (yaw 20) and back (200), 512 x 512; `head` 256 x 256. Measures: psnr over the figure and 8
pixels around it, ssim, iou of alpha > .5 (of the body; `head_iou` of the head), hf (energy finer than a 3-pixel blur
inside the figure over the true one's) and cor (its correlation with the true one's); means over all pictures.

Samples: `sample_head_hf_over_codec` is the fine energy of generated heads over that of held-out ones after the codec,
`sample_rest_std_<region>` the spread of what person components leave out over that of held-out people, `skin_*_ratio`
the Lab distance of the face to bare forearms (to `hands`) within a person over that of held-out people's meshes, read
from rendered pixels of the front view under the cells of those parts.

Fits: `fit_repeat_cosine_rest` compares what person components leave out of two fits whose cameras stand half a step
apart, `fit_unexplained_rms` is what the model leaves of a fit when it denoises it from step 100 without noise (rms of
latents), `fit_cpu_seconds` the processor's time of one fit, `fit_colouring_cpu_seconds` of each further colouring,
`payload_pose_gain_db` what fitted payloads gain over from_mesh in seven other poses, and `_head_` at the head.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from chain_sets import (
    FIRST_SEED,
    at_density,
    body_camera_of,
    decoded,
    denoised_once,
    draw,
    explained,
    fit,
    generated,
    head_camera,
    held_out,
    latents_of,
    learns_fitted,
    posed_scenes,
    recoloured,
    rest_of,
    rest_scene,
    start_of,
    stored,
    stored_fit,
)
from figure_metrics import compare_detail, detail_energy, figure_psnr
from jaxtyping import Float
from numpy import ndarray
from PIL import Image
from primdiffusion.body.model import default_body
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.editing.regions import region_of
from primdiffusion.evaluation.metrics import overlap, ssim
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.image import decode_srgb, encode_srgb
from primdiffusion.people.assets import Assets, open_assets
from primdiffusion.people.payloads import head_centre, make_payloads, rest_frames
from primdiffusion.people.wardrobe import required_meshes
from primdiffusion.primitives.anchors import CHARTS, attach, default_anchors
from primdiffusion.primitives.from_mesh import FULL_DENSITY
from record import report
from torch import Tensor

Figures = dict[str, float | int | bool | str | None]
PAYLOAD_PEOPLE = 3
"""Number of humans whose fits are repeated, timed and posed."""
COLOURINGS = 2
"""Number of further colourings that are timed."""
SHEET_PEOPLE = 6
SHEET_STAGES = ("true", "from_mesh", "payload", "codec", "step300", "step700")
NOISE_SEED = 1000
SHEET_SIDE = 256
"""Pixels a side of each picture of the sheet."""
GREY = 0.5
"""sRGB-encoded background of all pictures."""
VISIBLE_ALPHA = 0.9
"""Pixels less opaque than this are not read for skin colours."""
FACING = 0.5
"""Cosine between a cell's normal and the way to the camera above which its pixel is read for skin colours."""
BARE = 20.0
"""CIE Lab: a forearm farther than this from the hands' colour wears a sleeve."""
SKIN_PARTS = ("face", "forearms", "hands")
XYZ_OF_RGB = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
"""Of linear sRGB (IEC 61966-2-1); its rows' sums are the white point D65."""

Measures = Mapping[str, float]


def main() -> None:
    arguments = parsed()
    count, samples, skins = (2, 4, 4) if arguments.quick else (arguments.people, arguments.samples, arguments.skins)
    model = load_checkpoint(arguments.checkpoint)
    assets = open_assets(arguments.assets, required_meshes())
    if arguments.without_fits and learns_fitted(model):
        raise SystemExit("this checkpoint learned fitted payloads: leave --without-fits out")
    figures: Figures = {"people": count, "samples": samples}
    with tempfile.TemporaryDirectory() as scratch:
        held = None if arguments.without_fits else arguments.held or Path(scratch)
        if held is not None:
            make_payloads(assets, held, count, 1, FIRST_SEED, arguments.workers, report=progress("fitted"))
        chain = Chain()
        for number in range(count):
            chain.add(model, assets, held, number)
            progress("people")(number + 1, count)
        if arguments.sheet is not None:
            save_sheet(chain.pictures, arguments.sheet)
        figures |= chain.figures()
        report(figures, arguments.json)  # what is known so far: the rest takes long
        figures |= sample_figures(model, assets, chain, samples, skins)
        report(figures, arguments.json)
        if held is not None:
            figures |= payload_figures(model, assets, held, 1 if arguments.quick else PAYLOAD_PEOPLE)
    report(figures, arguments.json)


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--assets", type=Path, help="MakeHuman asset folder (or PRIMDIFFUSION_ASSETS)")
    parser.add_argument("--checkpoint", type=Path, help="without it the package's default")
    parser.add_argument("--people", type=int, default=16, help="held-out people")
    parser.add_argument("--samples", type=int, default=64, help="generated people")
    parser.add_argument("--skins", type=int, default=64, help="held-out people whose skin is compared")
    parser.add_argument("--held", type=Path, help="folder that keeps fitted payloads of held-out people between runs")
    parser.add_argument("--workers", type=int, default=1, help="processes that fit payloads")
    parser.add_argument("--without-fits", action="store_true", help="no stage `payload`; of old checkpoints alone")
    parser.add_argument("--quick", action="store_true", help="2 people, 4 samples")
    parser.add_argument("--sheet", type=Path, help="PNG of heads and fronts, a row per person")
    parser.add_argument("--json", type=Path, help="file for the figures")
    return parser.parse_args()


class Chain:
    """Results of each stage for held-out humans, added one by one."""

    def __init__(self) -> None:
        self.rows: dict[tuple[str, str], list[Measures]] = {}
        self.latents: list[Tensor] = []
        self.codec_head_energy: list[float] = []
        self.pictures: list[dict[str, tuple[Tensor, Tensor]]] = []
        """Head and front of the first humans at SHEET_STAGES."""

    def add(self, model: DiffusionModel, assets: Assets, held: Path | None, number: int) -> None:
        """Measure one human at all stages; `held` is the folder of fitted payloads; None skips that stage."""
        person = held_out(assets, number)
        scene = rest_scene(person)
        start = stored(start_of(person, scene.frames), person.betas)
        fitted = None if held is None else stored_fit(held, number)
        learned = fitted if fitted is not None and learns_fitted(model) else start
        x0 = latents_of(model, learned)
        self.latents.append(x0)
        payloads = {"from_mesh": at_density(start, FULL_DENSITY)}
        if fitted is not None:
            payloads["payload"] = at_density(fitted, FULL_DENSITY)
        payloads |= {"codec_input": at_density(learned, model.full_density), "codec": decoded(model, x0)}
        for t, guess in denoised_once(model, x0, NOISE_SEED + number):
            payloads[f"step{t}"] = decoded(model, guess)
        shown: dict[str, dict[str, Tensor]] = {}
        for view in scene.cameras:
            true = scene.true(view)
            drawn = {name: scene.drawn(view, payload) for name, payload in payloads.items()}
            for name, rgba in (("mesh", scene.true(view, supersample=1)), *drawn.items()):
                self.rows.setdefault((name, "head" if view == "head" else "body"), []).append(compare(rgba, true))
            shown[view] = {"true": true, **drawn}
        head = shown["head"]["codec"]
        self.codec_head_energy.append(detail_energy(over_grey(head), head[..., 3] > 0.5) or 0.0)
        if number < SHEET_PEOPLE:
            names = [name for name in SHEET_STAGES if name in shown["head"]]
            self.pictures.append({n: (over_grey(shown["head"][n]), over_grey(shown["front"][n])) for n in names})

    def figures(self) -> Figures:
        """Mean figures by stage and view."""
        figures: Figures = {}
        for (stage, view), rows in self.rows.items():
            for measure, value in means(rows).items():
                name = "iou" if (measure, view) == ("iou", "body") else f"{view}_{measure}"
                figures[f"{stage}_{name}"] = round(value, 4)
        psnr = {stage: means(rows)["psnr"] for (stage, view), rows in self.rows.items() if view == "head"}
        figures["step300_head_loss_db"] = round(psnr["codec"] - psnr["step300"], 4)
        return figures


def payload_figures(model: DiffusionModel, assets: Assets, held: Path, count: int) -> Figures:
    """Repeatability of fits, what they leave the model to guess, their cost, and their gain in other poses."""
    cosines, unexplained, seconds, gains = [], [], [], {"front": [], "head": []}
    base = load_checkpoint()  # from whose guesses the held-out fits start
    colouring = None
    for number in range(count):
        person = held_out(assets, number)
        frames = rest_frames(person.betas)
        start, fitted = start_of(person, frames), at_density(stored_fit(held, number), FULL_DENSITY)
        (turned,), spent = fit([person], frames, base, turn=0.5)
        samples = [latents_of(model, each) for each in (stored_fit(held, number), stored(turned, person.betas))]
        rest = rest_of(model, samples)
        if rest is not None:
            cosines.append(float(torch.nn.functional.cosine_similarity(*rest.flatten(1), dim=0)))
        unexplained.append(float((samples[0] - explained(model, samples[0])).square().mean().sqrt()))
        seconds.append(spent)
        if number == count - 1:  # one after the other: the machine's speed changes
            _, alone = fit([person], frames, base, turn=0.5)
            _, more = fit(recoloured(person, number, COLOURINGS), frames, base, turn=0.5)
            colouring = (more - alone) / COLOURINGS
        plain = at_density(stored(start, person.betas), FULL_DENSITY)
        for scene in posed_scenes(person):
            for view, gained in gains.items():
                true = scene.true(view)
                before, after = (compare(scene.drawn(view, payload), true)["psnr"] for payload in (plain, fitted))
                gained.append(after - before)
        progress("repeated and posed")(number + 1, count)
    return {
        "fit_repeat_cosine_rest": float(np.mean(cosines)) if cosines else None,
        "fit_repeat_cosine_rest_min": min(cosines, default=None),
        "fit_unexplained_rms": float(np.mean(unexplained)),
        "fit_cpu_seconds": float(np.median(seconds)),
        "fit_colouring_cpu_seconds": colouring,
        "payload_pose_gain_db": float(np.mean(gains["front"])),
        "payload_pose_head_gain_db": float(np.mean(gains["head"])),
    }


def sample_figures(model: DiffusionModel, assets: Assets, chain: Chain, count: int, skins: int) -> Figures:
    """Sharpness, variety and skin consistency of generated humans relative to held-out ones."""
    skins_held = []
    for number in range(skins):
        person = held_out(assets, number)
        scene = rest_scene(person)
        skins_held.append(skin_colours(scene.true("front", 1), scene.cameras["front"], torch.from_numpy(person.betas)))
        progress("skins")(number + 1, skins)
    energies, samples, made = [], [], []
    for x0, human in generated(model, count):
        betas = human.betas.numpy()
        frames, camera = rest_frames(betas), body_camera_of(betas)
        head = draw(frames, human.payload, head_camera(head_centre(betas)))
        energies.append(detail_energy(over_grey(head), head[..., 3] > 0.5) or 0.0)
        made.append(skin_colours(draw(frames, human.payload, camera), camera, human.betas))
        samples.append(x0)
        progress("samples")(len(samples), count)
    figures: Figures = {"sample_head_hf_over_codec": float(np.mean(energies) / np.mean(chain.codec_head_energy))}
    rest, rest_held = rest_of(model, samples), rest_of(model, chain.latents)
    if rest is not None and rest_held is not None:
        real = rest_std(rest_held)
        figures |= {f"sample_rest_std_{name}": value / real[name] for name, value in rest_std(rest).items()}
    return figures | skin_figures(skin_differences(made), skin_differences(skins_held))


def progress(what: str) -> Callable[[int, int], None]:
    def report(done: int, total: int) -> None:
        print(what, done, "of", total, flush=True)

    return report


def over_grey(rgba: Float[Tensor, "H W 4"]) -> Float[Tensor, "H W 3"]:
    """The encoded picture over GREY of linear colour premultiplied by alpha."""
    background = decode_srgb(torch.tensor(GREY))
    return encode_srgb((rgba[..., :3] + (1 - rgba[..., 3:]) * background).clamp(0, 1))


def compare(drawn: Float[Tensor, "H W 4"], true: Float[Tensor, "H W 4"]) -> Measures:
    """psnr (dB, over the figure and a margin), ssim, iou, hf and cor of a picture against the true one."""
    image, target = over_grey(drawn), over_grey(true)
    figure, true_figure = drawn[..., 3] > 0.5, true[..., 3] > 0.5
    detail = compare_detail(image, figure, target, true_figure)
    return {
        "psnr": float(figure_psnr(image, target, true_figure)),
        "ssim": float(ssim(image, target)),
        "iou": overlap(figure, true_figure),
        "hf": 0.0 if detail is None else detail.energy,
        "cor": 0.0 if detail is None else detail.correlation,
    }


def means(rows: Sequence[Measures]) -> dict[str, float]:
    """Of each measure over pictures."""
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def rest_std(rest: Float[Tensor, "n c 32 32"]) -> dict[str, float]:
    """Root mean square by region of the body of what person components leave out."""
    cells, chart = rest.flatten(2), default_anchors().chart
    return {name: float(cells[..., chart == number].square().mean().sqrt()) for number, name in enumerate(CHARTS)}


def skin_colours(rgba: Float[Tensor, "H W 4"], camera: Camera, betas: Tensor) -> dict[str, Float[ndarray, "3"]]:
    """CIE Lab of face, forearms and hands: the median of the pixels on which their cells' anchors fall.

    Cells that face away from the camera and pixels with less than VISIBLE_ALPHA are left out; so is a part without any.
    """
    body, anchors = default_body(), default_anchors()
    frames = attach(anchors, body.shape(betas.to(body.template.dtype)).vertices, body.faces)
    way = torch.nn.functional.normalize(camera.position - frames.position, dim=-1)
    facing = (frames.rotation[..., 2] * way).sum(-1) > FACING
    places, _ = camera.project(frames.position)
    column, row = places.long().clamp_min(0).unbind(-1)
    pixel = rgba[row.clamp_max(camera.height - 1), column.clamp_max(camera.width - 1)]
    seen = facing & (pixel[:, 3] > VISIBLE_ALPHA)
    colours = {}
    for part in SKIN_PARTS:
        chosen = pixel[seen & region_of([part])]
        if len(chosen):
            lab = lab_of_linear((chosen[:, :3] / chosen[:, 3:]).numpy())
            colours[part] = np.median(lab, axis=0)
    return colours


def lab_of_linear(rgb: Float[ndarray, "*n 3"]) -> Float[ndarray, "*n 3"]:
    """CIE L*a*b* (D65) of linear sRGB."""
    ratio = rgb.clip(0, 1).astype(np.float64) @ XYZ_OF_RGB.T / XYZ_OF_RGB.sum(1)
    f = np.where(ratio > (6 / 29) ** 3, np.cbrt(ratio), ratio / (3 * (6 / 29) ** 2) + 4 / 29)
    x, y, z = f[..., 0], f[..., 1], f[..., 2]
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def skin_differences(people: Sequence[Mapping[str, ndarray]]) -> dict[str, list[float]]:
    """Lab distance of the face to forearms (bare ones alone) and to hands, person by person."""
    differences: dict[str, list[float]] = {"forearm": [], "hands": []}
    for colours in people:
        if "face" not in colours or "hands" not in colours:
            continue
        face, hands = colours["face"], colours["hands"]
        differences["hands"].append(float(np.linalg.norm(face - hands)))
        forearms = colours.get("forearms")
        if forearms is not None and np.linalg.norm(forearms - hands) < BARE:
            differences["forearm"].append(float(np.linalg.norm(face - forearms)))
    return differences


def skin_figures(
    made: Mapping[str, Sequence[float]], real: Mapping[str, Sequence[float]]
) -> dict[str, float | int | None]:
    """Mean and 90th percentile of differences, and what share of held-out people's they are."""
    figures: dict[str, float | int | None] = {}
    for part, suffix in (("forearm", ""), ("hands", "_hands")):
        few = not made[part] or not real[part]
        for name, statistic in (("", np.mean), ("_p90", lambda values: np.percentile(values, 90))):
            ours, theirs = (None, None) if few else (float(statistic(made[part])), float(statistic(real[part])))
            figures[f"skin{suffix}_difference{name}"] = ours
            figures[f"skin{suffix}_difference{name}_held"] = theirs
            figures[f"skin{suffix}_difference{name}_ratio"] = None if ours is None else ours / max(theirs or 0.0, 1e-6)
        figures[f"skin{suffix}_people"], figures[f"skin{suffix}_people_held"] = len(made[part]), len(real[part])
    return figures


def save_sheet(people: Sequence[Mapping[str, tuple[Tensor, Tensor]]], path: Path) -> None:
    """Heads, then fronts, at each stage; a row per person."""
    rows = []
    for stages in people:
        cells = [pair[part] for part in (0, 1) for pair in stages.values()]
        images = [Image.fromarray((cell.numpy() * 255).round().astype(np.uint8)) for cell in cells]
        rows.append(np.concatenate([np.asarray(image.resize((SHEET_SIDE, SHEET_SIDE))) for image in images], axis=1))
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate(rows)).save(path, optimize=True)


if __name__ == "__main__":
    main()
