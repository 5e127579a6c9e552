"""The commands that write, small enough to take a second each, and what is the same in two of their results."""

from __future__ import annotations

import dataclasses
import functools
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from capture_scenes import save_person, small_job
from chaos.forks import Death, Ended, Forks
from diffusion_people import small_model, write_people
from primdiffusion.capture.render import render
from primdiffusion.diffusion.checkpoint import save_checkpoint
from primdiffusion.human import generate
from primdiffusion.human_file import save_human
from released_files import TINY, random_network, save_body, save_released, state, template
from tiny_encoder import save_tiny_encoder
from tiny_model import save_tiny_checkpoint, tiny_model

Words = Sequence[str | Path]
ASSETS = "PRIMDIFFUSION_ASSETS"


@dataclasses.dataclass(frozen=True)
class Program:
    """A command line that writes to a folder."""

    name: str
    arguments: Callable[[Path], Words]
    """Of an output folder, which exists."""
    small: str = ""
    """The module of tests whose `make_small` it needs."""
    copied: Callable[[], Path] | None = None
    """Returns a folder that the command works in, copied to the output folder first."""
    resumes: bool = False
    """Keeps what is finished when it fails, and goes on from there; other commands leave all files or none."""
    request: Callable[[Path], Mapping[str, Any]] | None = None
    """What `serve` is asked for, of an output folder."""

    def run(self, forks: Forks, out: Path, death: Death | None = None, file_limit: int | None = None) -> Ended:
        """Run it in an output folder."""
        request = None if self.request is None else self.request(out)
        return forks.run(self.arguments(out), self.small, death, file_limit, request)

    def prepare(self, out: Path) -> None:
        """Make the output folder."""
        if self.copied is None:
            out.mkdir()
        else:
            shutil.copytree(self.copied(), out)


def makehuman() -> Path | None:
    """MakeHuman's assets, which two of the commands need, or None."""
    folder = os.environ.get(ASSETS)
    return Path(folder) if folder and Path(folder).is_dir() else None


class Inputs:
    """Inputs of the commands; each is made when it is first needed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @functools.cached_property
    def checkpoint(self) -> Path:
        """A tiny diffusion model."""
        return save_tiny_checkpoint(self.folder / "tiny.safetensors")

    @functools.cached_property
    def base(self) -> Path:
        """A diffusion model with small networks."""
        save_checkpoint(self.folder / "base.safetensors", small_model(), "linear")
        return self.folder / "base.safetensors"

    @functools.cached_property
    def encoder(self) -> Path:
        """A tiny encoder."""
        return save_tiny_encoder(self.folder / "encoder.safetensors")

    @functools.cached_property
    def captures(self) -> Path:
        """Captures of two humans in two poses."""
        job = small_job(self.folder / "made", people=2, frames=2, passes=("img", "mask", "depth"))
        assert {outcome.status for outcome in render(job)} == {"done"}
        return job.out

    @functools.cached_property
    def meshes(self) -> Path:
        """A folder of two rigged meshes."""
        for number in range(2):
            save_person(self.folder / "meshes" / f"person_{number:06d}" / "person.glb")
        return self.folder / "meshes"

    @functools.cached_property
    def people(self) -> Path:
        """Payloads of eight humans in two colourings."""
        write_people(self.folder / "people", geometries=8, variants=2)
        return self.folder / "people"

    @functools.cached_property
    def released(self) -> Path:
        """A checkpoint in the authors' format, and a body in SMPL's."""
        folder = self.folder / "released"
        folder.mkdir()
        save_body(folder)
        save_released(folder / "primdiffusion.pt", state(random_network(TINY).state_dict(), template()))
        return folder

    def human(self, seed: int) -> Path:
        """A generated human."""
        path = self.folder / f"human{seed}" / "person.human.safetensors"
        if not path.exists():
            path.parent.mkdir()
            save_human(path, generate(tiny_model(), seed, 2))
        return path

    @property
    def sampled(self) -> list[str | Path]:
        """Options of a command that samples."""
        return ["--steps", "2", "--size", "16", "--checkpoint", self.checkpoint]


def all_programs(given: Inputs) -> list[Program]:
    """Every command that writes."""

    def edit(command: str, options: Callable[[], Words]) -> Program:
        return Program(command, lambda out: [command, *options(), *given.sampled, "--out", out / "new"])

    def export(ending: str, *options: str, small: str = "") -> Program:
        def words(out: Path) -> Words:
            return ["export", given.human(1), *options, "--out", out / f"human{ending}"]

        return Program(f"export {ending}", words, small=small)

    return [
        Program(
            "generate",
            lambda out: ["generate", *given.sampled, "--count", "2", "--out", out / "new"],
            resumes=True,
        ),
        edit("vary", lambda: [given.human(1), "--seed", "3"]),
        edit("interpolate", lambda: [given.human(1), given.human(2)]),
        edit("inpaint", lambda: [given.human(1), "--region", "head"]),
        edit("transfer", lambda: [given.human(1), "--source", given.human(2), "--region", "head"]),
        Program(
            "reconstruct",
            lambda out: ["reconstruct", "--capture", given.captures, "--subject", "person_000000", "--views", "2",
                         "--size", "16", "--checkpoint", given.encoder, "--out", out / "new"],
        ),
        Program(
            "refine",
            lambda out: ["refine", "--capture", given.captures, "--subject", "person_000000", "--steps", "1",
                         "--size", "16", "--hold-out-cameras", "1", "--out", out / "new"],
        ),
        Program(
            "render",
            lambda out: ["render", given.human(1), "--size", "32", "--out", out / "a.png", "--depth", out / "b.png"],
        ),
        export(".glb", "--triangles", "500", "--texture", "64", "--spacing", "0.03"),
        export(".obj", "--triangles", "500", "--texture", "64", "--spacing", "0.03"),
        export(".ply", "--gaussians", "100"),
        Program(
            "merge",
            lambda out: ["merge", given.human(1), given.human(2), "--voxel", "0.05", "--out", out / "merged.npz"],
        ),
        Program(
            "captures sheet",
            lambda out: ["captures", "sheet", given.captures, "--rows", "1", "--columns", "2", "--out",
                         out / "sheet.png"],
        ),
        Program(
            "captures render",
            lambda out: ["captures", "render", "--people", given.meshes, "--out", out, "--cameras", "3",
                         "--pose-count", "2", "--size", "16"],
            resumes=True,
        ),
        Program("captures coco", lambda out: ["captures", "coco", out], copied=lambda: given.captures, resumes=True),
        Program("captures pack", lambda out: ["captures", "pack", out], copied=lambda: given.captures, resumes=True),
        Program(
            "payloads encode",
            lambda out: ["payloads", "encode", "--captures", given.captures, "--encoder", given.encoder, "--views", "2",
                         "--out", out],
            resumes=True,
        ),
        Program("fit", lambda out: fit_words(given.captures, out), small="fit_scenes", resumes=True),
        Program("train", lambda out: train_words(given.people, out), small="diffuse_runs", resumes=True),
        Program(
            "evaluate",
            lambda out: ["evaluate", "reconstruction", "--captures", given.captures, "--checkpoint", given.encoder,
                         "--people", "1", "--views", "2", "--size", "16", "--json", out / "scores.json"],
        ),
        Program(
            "import-released",
            lambda out: ["import-released", given.released / "primdiffusion.pt", "--smpl",
                         given.released / "SMPL_NEUTRAL.pkl", "--uv", given.released / "smpl_uv.obj", "--out",
                         out / "model.safetensors", "--report", out / "report.json"],
        ),
        *served(given),
        *_made_of_assets(makehuman()),
    ]  # fmt: skip


def served(given: Inputs) -> list[Program]:
    """Every request of the child that writes files."""

    def asked(method: str, params: Callable[[Path], Mapping[str, Any]], resumes: bool = False) -> Program:
        def request(out: Path) -> dict[str, Any]:
            named = {name: str(value) if isinstance(value, Path) else value for name, value in params(out).items()}
            return {"method": method, "params": named}

        return Program(f"serve {method}", lambda _out: ["serve"], resumes=resumes, request=request)

    def sampled(method: str, params: Callable[[], Mapping[str, Any]]) -> Program:
        small = {"steps": 2, "size": 16}
        return asked(method, lambda out: {**small, "checkpoint": given.checkpoint, "out_dir": out / "new", **params()})

    def posed(*seeds: int) -> list[dict[str, Any]]:
        still = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]
        return [{"human": str(given.human(seed)), "object": still, "joints": [still] * 24} for seed in seeds]

    return [
        sampled("generate", lambda: {"seed": 1, "picture_px": 8}),
        sampled("variations", lambda: {"seeds": [1, 2]}),
        sampled("vary", lambda: {"person": given.human(1), "seed": 3}),
        sampled("interpolate", lambda: {"person": given.human(1), "other": given.human(2)}),
        sampled("inpaint", lambda: {"person": given.human(1), "region": ["head"]}),
        sampled("transfer", lambda: {"person": given.human(1), "source": given.human(2), "region": ["head"]}),
        asked(
            "reconstruct",
            lambda out: {"capture": given.captures, "subject": "person_000000", "views": 2, "size": 16,
                         "checkpoint": given.encoder, "out_dir": out / "new"},
        ),
        asked("open_human", lambda out: {"person": given.human(1), "out_dir": out / "new", "size": 16}),
        asked(
            "render",
            lambda out: {"human": given.human(1), "out": out / "a.png", "depth": out / "b.png", "width": 32,
                         "height": 32},
        ),
        asked("merge", lambda out: {"people": posed(1, 2), "out": out / "merged.npz", "voxel": 0.05}),
        asked(
            "merge_frames",
            lambda out: {"people": posed(1, 1), "out_dir": out / "new", "voxel": 0.05},
            resumes=True,
        ),
        asked(
            "proxy",
            lambda out: {"person": given.human(1), "out_dir": out / "new", "triangles": 500, "texture_px": 64,
                         "spacing": 0.03},
        ),
        asked("gaussians", lambda out: {"person": given.human(1), "out": out / "a.ply", "limit": 100}),
    ]  # fmt: skip


def _made_of_assets(assets: Path | None) -> list[Program]:
    if assets is None:
        return []
    return [
        Program(
            "people",
            lambda out: ["people", "--assets", assets, "--count", "2", "--workers", "1", "--out", out],
            resumes=True,
        ),
        Program(
            "payloads",
            lambda out: ["payloads", "--assets", assets, "--count", "2", "--variants", "1", "--workers", "1",
                         "--making", "from_mesh", "--out", out],
            resumes=True,
        ),
    ]  # fmt: skip


def fit_words(captures: Path, run: Path) -> Words:
    """A run of stage 1 of three steps, saved after each."""
    return ["fit", "--data", captures, "--run", run, "--steps", "3", "--batch", "1", "--views", "2", "--targets", "1",
            "--size", "16", "--step", "0.02", "--hold-scale", "2", "--log-every", "1", "--threads", "1",
            "--learning-rate", "1e-4", "--save-every", "0"]  # fmt: skip


TRAINED = ["--holdout", "0.25", "--log-every", "1", "--threads", "1", "--save-every", "0", "--codec.people", "4"]


def train_words(people: Path, run: Path) -> Words:
    """A run of stage 2 of two steps of each network, saved after each."""
    phases = [
        word
        for phase in ("person", "local")
        for word in (f"--{phase}.steps", "2", f"--{phase}.batch", "2", f"--{phase}.evaluate-every", "2")
    ]
    person = ["model.person:person-network-config", "--model.person.width", "16", "--model.person.blocks", "1"]
    return ["train", "--data", people, "--run", run, *TRAINED, *phases, "--codec.channels", "4", "--prior.components",
            "3", *person, "model.local:local-u-net-config", *_network("--model.local.")]  # fmt: skip


def _network(prefix: str) -> list[str]:
    sizes = {"widths": ["8", "8"], "position-channels": ["2"], "condition-width": ["8"], "heads": ["2"]}
    return [word for name, values in sizes.items() for word in (prefix + name, *values)]
