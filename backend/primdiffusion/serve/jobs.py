"""The work of the child: generate, edit, reconstruct, render, draw. It imports torch, so the server loads it late."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torch import Tensor

from primdiffusion.checkpoints import load_checkpoint
from primdiffusion.diffusion.checkpoint import read_card
from primdiffusion.diffusion.conditioning import NOTHING
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.human import Human, framing, generate, people_of, place
from primdiffusion.human_file import load_human
from primdiffusion.machine import best_device, device_info, peak_memory_gb
from primdiffusion.person_folder import FILES, write_person
from primdiffusion.pose_file import pose_from_numbers, read_pose
from primdiffusion.render.image import depth_to_png, to_png
from primdiffusion.render.march import march
from primdiffusion.serve import exporting
from primdiffusion.serve.draw_params import DrawParams
from primdiffusion.serve.drawing import FrameDrawer
from primdiffusion.serve.edit_params import InpaintParams, InterpolateParams, TransferParams, VaryParams
from primdiffusion.serve.editing import Editor
from primdiffusion.serve.export_params import GaussiansParams, HumanNpzParams, ProxyParams
from primdiffusion.serve.merge_params import FitGainParams, MergeFramesParams, MergeParams
from primdiffusion.serve.merging import fit_gain_of, merge_frames, merge_people
from primdiffusion.serve.params import AttributesParams, GenerateParams, ReconstructParams, RenderParams
from primdiffusion.serve.progress import Report, step_reporter
from primdiffusion.serve.step_pictures import step_pictures
from primdiffusion.serve.variation_params import VariationsParams
from primdiffusion.serve.variations import variations
from primdiffusion.staging import staged, written_whole

if TYPE_CHECKING:
    from primdiffusion.serve.reconstruction import Reconstructor


class Jobs:
    """Runs jobs one after the other and keeps the models of the last ones, and of pictures their people, in memory."""

    def __init__(self) -> None:
        self._device = best_device()
        self._loaded: tuple[str | None, DiffusionModel] | None = None
        self._reconstructor: Reconstructor | None = None
        self._drawer = FrameDrawer(self._device)
        self._editor = Editor(self._model)

    def device_info(self) -> dict[str, Any]:
        """As `ready` and `hello` state it."""
        return device_info(self._device)

    def generate(self, params: GenerateParams, report: Report) -> dict[str, Any]:
        """Samples a person and writes it to `out_dir`, all files or none; returns their paths and what it took.

        Raises OSError before any work if the folder cannot be written to; what load_checkpoint and generate raise.
        """
        began = time.perf_counter()
        out = Path(params.out_dir)
        with staged(out) as folder:
            report("load", 0, params.steps, None)
            model = self._model(params.checkpoint)
            report("sample", 0, params.steps, None)

            def show(x0: Tensor) -> Human:
                return people_of(model, x0, [params.seed], params.attributes)[0]

            with step_pictures(folder, params.picture_px, show) as picture:
                human = generate(
                    model,
                    params.seed,
                    params.steps,
                    params.sampler,
                    step_reporter(report, picture),
                    params.attributes,
                    params.guidance,
                )
            sampled = time.perf_counter()
            report("write", params.steps, params.steps, None)
            write_person(folder, human, params.size)
            report("write", params.steps, params.steps, 0.0)  # the last chance to cancel
        return {
            **FILES.in_folder(out),
            "seed": params.seed,
            "steps": params.steps,
            "seconds": round(time.perf_counter() - began, 3),
            "seconds_sampling": round(sampled - began, 3),
            "peak_gb": round(peak_memory_gb(), 3),
        }

    def variations(self, params: VariationsParams, report: Report) -> dict[str, Any]:
        """Makes people to choose from (see `serve.variations`)."""
        return variations(self._model, params, report)

    def attributes(self, params: AttributesParams, report: Report) -> dict[str, Any]:
        """What a checkpoint can be asked for: values of categories, mean and standard deviation of scalars.

        Raises what read_card does.
        """
        return read_card(params.checkpoint).get("attributes", NOTHING.to_json())

    def vary(self, params: VaryParams, report: Report) -> dict[str, Any]:
        """Makes a neighbour of a person (see `Editor`, also for the next three)."""
        return self._editor.vary(params, report)

    def interpolate(self, params: InterpolateParams, report: Report) -> dict[str, Any]:
        """Makes a person between two."""
        return self._editor.interpolate(params, report)

    def inpaint(self, params: InpaintParams, report: Report) -> dict[str, Any]:
        """Makes a region of a person anew."""
        return self._editor.inpaint(params, report)

    def transfer(self, params: TransferParams, report: Report) -> dict[str, Any]:
        """Gives a person another one's looks in a region."""
        return self._editor.transfer(params, report)

    def reconstruct(self, params: ReconstructParams, report: Report) -> dict[str, Any]:
        """Makes a person of captures (see `Reconstructor.reconstruct`)."""
        if self._reconstructor is None:
            from primdiffusion.serve.reconstruction import Reconstructor  # children that only generate start sooner

            self._reconstructor = Reconstructor(self._device)
        return self._reconstructor.reconstruct(params, report)

    def render(self, params: RenderParams, report: Report) -> dict[str, Any]:
        """Draws a saved person; returns the picture's path. Raises what load_human and read_pose do, and OSError."""
        began = time.perf_counter()
        report("load", 0, 1, None)
        human = load_human(params.human)
        pose = None
        if params.pose is not None:
            by_path = params.pose if isinstance(params.pose, str) else None
            pose = read_pose(by_path) if by_path else pose_from_numbers(params.pose, "the parameter pose")
        primitives = place(human, pose)
        report("render", 0, 1, None)
        rendering = march(primitives, framing(primitives, params.yaw, params.width, params.height))
        report("write", 1, 1, 0.0)
        with contextlib.ExitStack() as files:  # both pictures or none
            to_png(files.enter_context(written_whole(params.out)), rendering)
            if params.depth is not None:
                depth_to_png(files.enter_context(written_whole(params.depth)), rendering)
        return {"out": params.out, "depth": params.depth, "seconds": round(time.perf_counter() - began, 3)}

    def draw(self, params: DrawParams, report: Report) -> dict[str, Any]:
        """Fills a frame (see `FrameDrawer.draw`). Needs no checkpoint."""
        return self._drawer.draw(params, report)

    def merge(self, params: MergeParams, report: Report) -> dict[str, Any]:
        """Makes one grid of voxels of people (see `merge_people`). Needs no checkpoint."""
        return merge_people(params, report)

    def merge_frames(self, params: MergeFramesParams, report: Report) -> dict[str, Any]:
        """Makes a grid for each frame of a person (see `serve.merging`). Needs no checkpoint."""
        return merge_frames(params, report)

    def fit_gain(self, params: FitGainParams, report: Report) -> dict[str, Any]:
        """Fits the density gain of exponential renderers (see `fit_gain_of`). Needs no checkpoint."""
        return fit_gain_of(params, report)

    def proxy(self, params: ProxyParams, report: Report) -> dict[str, Any]:
        """Makes a textured mesh of a person (see `serve.exporting`, also for the next two). Needs no checkpoint."""
        return exporting.proxy(params, report)

    def gaussians(self, params: GaussiansParams, report: Report) -> dict[str, Any]:
        """Writes a person as 3D Gaussians."""
        return exporting.gaussians(params, report)

    def human_npz(self, params: HumanNpzParams, report: Report) -> dict[str, Any]:
        """Writes the files of generate for a person who exists."""
        return exporting.human_npz(params, report)

    def _model(self, checkpoint: str | None) -> DiffusionModel:
        if self._loaded is None or self._loaded[0] != checkpoint:
            self._loaded = None  # frees the old one first
            self._loaded = (checkpoint, load_checkpoint(checkpoint, self._device))
        return self._loaded[1]
