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

Payloads: `payload_repeat_cosine` compares the changes of two fits whose cameras stand half a step apart,
`payload_cpu_seconds` is the processor's time of one fit, `payload_colouring_cpu_seconds` of each further colouring,
`payload_pose_gain_db` what fitted payloads gain over from_mesh in seven other poses, and `_head_` at the head.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from chain_measures import (
    Measures,
    change_cosine,
    compare,
    means,
    over_grey,
    rest_std,
    save_sheet,
    skin_colours,
    skin_differences,
    skin_figures,
)
from chain_sets import (
    FIRST_SEED,
    at_density,
    body_camera_of,
    decoded,
    denoised_once,
    draw,
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
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.evaluation.image_metrics import detail_energy
from primdiffusion.people.assets import Assets, open_assets
from primdiffusion.people.payloads import head_centre, make_payloads, rest_frames
from primdiffusion.people.wardrobe import required_meshes
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
            figures |= payload_figures(assets, held, 1 if arguments.quick else PAYLOAD_PEOPLE)
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


def payload_figures(assets: Assets, held: Path, count: int) -> Figures:
    """Repeatability and cost of fits, and their gain in other poses."""
    cosines, seconds, gains = [], [], {"front": [], "head": []}
    colouring = None
    for number in range(count):
        person = held_out(assets, number)
        frames = rest_frames(person.betas)
        start, fitted = start_of(person, frames), at_density(stored_fit(held, number), FULL_DENSITY)
        (turned,), spent = fit([person], frames, turn=0.5)
        cosines.append(change_cosine(fitted, turned, start, FULL_DENSITY))
        seconds.append(spent)
        if number == count - 1:  # the first fit may have compiled
            _, more = fit(recoloured(person, number, COLOURINGS), frames, turn=0.5)
            colouring = (more - spent) / COLOURINGS
        plain = at_density(stored(start, person.betas), FULL_DENSITY)
        for scene in posed_scenes(person):
            for view, gained in gains.items():
                true = scene.true(view)
                before, after = (compare(scene.drawn(view, payload), true)["psnr"] for payload in (plain, fitted))
                gained.append(after - before)
        progress("repeated and posed")(number + 1, count)
    return {
        "payload_repeat_cosine": float(np.mean(cosines)),
        "payload_repeat_cosine_min": min(cosines),
        "payload_cpu_seconds": float(np.median(seconds)),
        "payload_colouring_cpu_seconds": colouring,
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


if __name__ == "__main__":
    main()
