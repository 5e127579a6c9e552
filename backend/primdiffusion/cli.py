"""The command line, for people who never open Blender: `primdiffusion generate --seed 7 --out DIR`.

Exit codes: 0 done, 1 an error of input, files or memory (one sentence on stderr), 2 wrong usage, 70 a defect of ours
(with its traceback), 130 interrupted. Results are printed on stdout, progress on stderr. torch is imported by the
commands that need it, so `--help` is quick.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import math
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import tyro

from primdiffusion import __version__
from primdiffusion.drawing.steps import check_step
from primdiffusion.export_command import Export
from primdiffusion.failures import describe
from primdiffusion.generate_command import Generate
from primdiffusion.machine import share_processors
from primdiffusion.merge_command import Merge

TRACEBACK = "--traceback"
DEFECT = 70
INTERRUPTED = 130
DESCRIPTION = f"""PrimDiffusion {__version__}: people as 1024 small volumes, from noise to pictures.

{TRACEBACK}, anywhere on the line, shows where an error came from."""
BACKGROUNDS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "transparent": None}


@dataclasses.dataclass(frozen=True)
class Render:
    """Draw a person in a pose."""

    human: tyro.conf.Positional[Path]
    """A .human.safetensors file."""
    out: Path
    """PNG to write."""
    yaw: float = 0.0
    """Degrees around the person: 0 the face, 90 their left side."""
    pose: Path | None = None
    """.json or .npz with 72 axis-angle numbers (24 joints x 3, radians); without it the T pose."""
    frame: int = 0
    """Which frame of a pose file that holds several."""
    size: int = 512
    """Width and height, pixels."""
    width: int | None = None
    """Pixels; without it the size."""
    height: int | None = None
    """Pixels; without it the size."""
    view: Literal["colour", "depth", "alpha", "boxes"] = "colour"
    """colour; depth in colours, bright where near; alpha: what the person covers, in grey; boxes: the primitives."""
    step: float = 0.004
    """Metres between samples of a ray; finer is slower and closer to the truth."""
    background: Literal["black", "white", "transparent"] = "black"
    """What is behind the person."""
    depth: Path | None = None
    """A second PNG: depth in colours, bright where near."""

    def run(self) -> None:
        """Draws, and prints the picture's path."""
        import torch

        from primdiffusion.drawing.draw import draw
        from primdiffusion.drawing.scene import Look, Scene
        from primdiffusion.human import body_of, framing, place
        from primdiffusion.human_file import load_human
        from primdiffusion.pose_file import read_pose
        from primdiffusion.render.image import depth_to_png, rgba_to_png
        from primdiffusion.render.march import MarchSettings, march
        from primdiffusion.staging import written_whole

        self._check()
        look = Look(self.view, settings=MarchSettings(step=self.step))
        human = load_human(self.human)
        primitives = place(human, None if self.pose is None else read_pose(self.pose, self.frame))
        width, height = (self.size if side is None else side for side in (self.width, self.height))
        camera = framing(primitives, math.radians(self.yaw), width, height)
        picture = draw(Scene(primitives, chart=body_of(human)[1].chart), camera, look)
        with contextlib.ExitStack() as files:  # both pictures or none
            rgba_to_png(
                files.enter_context(written_whole(self.out)),
                torch.from_numpy(picture.combined),
                BACKGROUNDS[self.background],
            )
            if self.depth is not None:
                rendering = march(primitives, camera, look.settings)
                depth_to_png(files.enter_context(written_whole(self.depth)), rendering)
        print(self.out)

    def _check(self) -> None:
        if not math.isfinite(self.yaw):
            raise ValueError(f"yaw is {self.yaw}: give an angle in degrees")
        check_step(self.step)
        if self.depth is not None and self.depth.resolve() == self.out.resolve():
            raise ValueError(f"out and depth are both {self.out}: name two files")
        if self.frame and self.pose is None:
            raise ValueError(f"frame {self.frame} was asked for without a pose file: name one with --pose")


@dataclasses.dataclass(frozen=True)
class Info:
    """Say what this installation, a checkpoint or a person is, as JSON."""

    file: tyro.conf.Positional[Path | None] = None
    """A .human.safetensors, a checkpoint or an encoder; without it versions, device, memory and the package's cards."""

    def run(self) -> None:
        """Prints one JSON object."""
        import torch

        from primdiffusion.diffusion.checkpoint import default_checkpoint, read_card
        from primdiffusion.encoder.checkpoint import default_encoder
        from primdiffusion.human_file import NoPersonError, format_version, load_human
        from primdiffusion.machine import best_device, device_info, memory

        if self.file is None:
            cards = {
                name: read_card(path) if path.exists() else None
                for name, path in (("checkpoint", default_checkpoint()), ("encoder", default_encoder()))
            }
            about = {"version": __version__, "torch": torch.__version__, **device_info(best_device()), **memory()}
            print(json.dumps({**about, **cards}, indent=2))
            return
        try:
            human = load_human(self.file)
        except NoPersonError:
            print(json.dumps(dict(read_card(self.file)), indent=2))
        else:
            betas = [round(beta, 4) for beta in human.betas.tolist()]
            body = "default" if human.body_setup is None else dataclasses.asdict(human.body_setup.files)
            about = {"format_version": format_version(human), **human.provenance, "betas": betas, "body": body}
            print(json.dumps(about, indent=2))


@dataclasses.dataclass(frozen=True)
class Vary:
    """Make a neighbour of a person (own --help)."""


@dataclasses.dataclass(frozen=True)
class Interpolate:
    """Make a person between two (own --help)."""


@dataclasses.dataclass(frozen=True)
class Inpaint:
    """Make a region of a person anew: re-dress them (own --help)."""


@dataclasses.dataclass(frozen=True)
class Transfer:
    """Give a region of a person the looks of another one (own --help)."""


@dataclasses.dataclass(frozen=True)
class Reconstruct:
    """Make a person from captures: pictures of them from several sides (own --help)."""


@dataclasses.dataclass(frozen=True)
class Refine:
    """Optimise one captured person until they look like their pictures (own --help)."""


@dataclasses.dataclass(frozen=True)
class People:
    """Make dressed, rigged people (glTF) from a MakeHuman asset folder, to render captures from (own --help)."""


@dataclasses.dataclass(frozen=True)
class Payloads:
    """Make such people, or captured ones, as primitives to train the diffusion model on; pack them (own --help)."""


@dataclasses.dataclass(frozen=True)
class Captures:
    """Pictures of such people from many sides: render, verify, info, pack, sheet (own --help)."""


@dataclasses.dataclass(frozen=True)
class Fit:
    """Train the encoder on captures: from pictures to primitives (own --help)."""


@dataclasses.dataclass(frozen=True)
class Train:
    """Train the diffusion model on such primitives (own --help)."""


@dataclasses.dataclass(frozen=True)
class ImportReleased:
    """Turn the authors' primdiffusion.pt and your SMPL file into a checkpoint for generate (own --help)."""


@dataclasses.dataclass(frozen=True)
class Evaluate:
    """Measure how good trained models are: reconstruction (own --help)."""


Command = (
    Annotated[Generate, tyro.conf.subcommand("generate")]
    | Annotated[Vary, tyro.conf.subcommand("vary")]
    | Annotated[Interpolate, tyro.conf.subcommand("interpolate")]
    | Annotated[Inpaint, tyro.conf.subcommand("inpaint")]
    | Annotated[Transfer, tyro.conf.subcommand("transfer")]
    | Annotated[Reconstruct, tyro.conf.subcommand("reconstruct")]
    | Annotated[Refine, tyro.conf.subcommand("refine")]
    | Annotated[Render, tyro.conf.subcommand("render")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[Merge, tyro.conf.subcommand("merge")]
    | Annotated[Info, tyro.conf.subcommand("info")]
    | Annotated[People, tyro.conf.subcommand("people")]
    | Annotated[Payloads, tyro.conf.subcommand("payloads")]
    | Annotated[Captures, tyro.conf.subcommand("captures")]
    | Annotated[Fit, tyro.conf.subcommand("fit")]
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[ImportReleased, tyro.conf.subcommand("import-released")]
)


def _edit(name: str, arguments: Sequence[str]) -> None:
    from primdiffusion.edit_command import run

    run(name, arguments)


def _reconstruct(arguments: Sequence[str]) -> None:
    from primdiffusion.reconstruct_command import run

    run(arguments)


def _refine(arguments: Sequence[str]) -> None:
    from primdiffusion.refine_command import run

    run(arguments)


def _people(arguments: Sequence[str]) -> None:
    from primdiffusion.people.command import PeopleCommand, run_people

    run_people(tyro.cli(PeopleCommand, args=arguments, prog="primdiffusion people"))


def _payloads(arguments: Sequence[str]) -> None:
    from primdiffusion.payloads_command import run

    run(arguments)


def _captures(arguments: Sequence[str]) -> None:
    from primdiffusion.capture.command import run

    run(arguments)


def _fit(arguments: Sequence[str]) -> None:
    from primdiffusion.training.fit_command import run

    run(arguments)


def _train(arguments: Sequence[str]) -> None:
    from primdiffusion.training.diffuse import run

    run(arguments)


def _import_released(arguments: Sequence[str]) -> None:
    from primdiffusion.import_released_command import run

    run(arguments)


def _evaluate(arguments: Sequence[str]) -> None:
    from primdiffusion.evaluation.command import StageTwo, TrainedReconstructor, run

    def load(path: Path | None) -> TrainedReconstructor:
        from primdiffusion.encoder.checkpoint import load_encoder
        from primdiffusion.machine import best_device

        return load_encoder(path, best_device())

    def stage_two() -> StageTwo:
        from primdiffusion.checkpoints import load_checkpoint
        from primdiffusion.machine import best_device
        from primdiffusion.training.latents import split_people
        from primdiffusion.training.stored_people import find_people, read_person

        return StageTwo(lambda path: load_checkpoint(path, best_device()), find_people, split_people, read_person)

    run(arguments, load, stage_two)


FORWARDED = {
    **{name: functools.partial(_edit, name) for name in ("vary", "interpolate", "inpaint", "transfer")},
    "reconstruct": _reconstruct,
    "refine": _refine,
    "people": _people,
    "payloads": _payloads,
    "captures": _captures,
    "fit": _fit,
    "train": _train,
    "evaluate": _evaluate,
    "import-released": _import_released,
}
"""Commands whose parameters their own modules state; importing these takes a second, so only when asked for."""


def run(arguments: Sequence[str]) -> None:
    """Parses and runs one command line, errors as exceptions."""
    if arguments and arguments[0] in FORWARDED:
        FORWARDED[arguments[0]](arguments[1:])
        return
    command = tyro.cli(Command, args=arguments or ["--help"], prog="primdiffusion", description=DESCRIPTION)
    assert isinstance(command, Generate | Render | Export | Merge | Info), "the others are forwarded"
    command.run()


def main(arguments: Sequence[str] | None = None) -> None:
    """The console script; ends the process with the exit codes above."""
    share_processors()
    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        run([argument for argument in given if argument != TRACEBACK])
    except KeyboardInterrupt:
        print("primdiffusion: interrupted", file=sys.stderr)
        sys.exit(INTERRUPTED)
    except Exception as e:
        failure = describe(e)
        if failure is None or TRACEBACK in given:
            traceback.print_exc()
        if failure is None:
            sys.exit(DEFECT)
        print(f"primdiffusion: {failure}", file=sys.stderr)
        sys.exit(1)


if __name__ == "__main__":
    main()
