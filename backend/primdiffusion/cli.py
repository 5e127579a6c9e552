"""The command line, for people who never open Blender: `primdiffusion generate --seed 7 --out DIR`.

Exit codes: 0 done, 1 an error of input, files or memory (one sentence on stderr), 2 wrong usage, 70 a defect of ours
(with its traceback), 130 interrupted. Results are printed on stdout, progress on stderr.
"""

from __future__ import annotations

import importlib
import sys
import traceback
from collections.abc import Sequence

from primdiffusion import __version__
from primdiffusion.failures import describe
from primdiffusion.machine import share_processors

TRACEBACK = "--traceback"
USAGE = 2
DEFECT = 70
INTERRUPTED = 130
COMMANDS = {
    "generate": ("commands.generate", "Generate people: for Blender, to keep, and pictures"),
    "vary": ("commands.vary", "Make a variant of a person"),
    "interpolate": ("commands.interpolate", "Make a person between two"),
    "inpaint": ("commands.inpaint", "Make a region of a person anew: re-dress them"),
    "transfer": ("commands.transfer", "Give a region of a person the looks of another one"),
    "reconstruct": ("commands.reconstruct", "Make a person from captures: pictures of them from several sides"),
    "refine": ("commands.refine", "Optimise one captured person until they look like their pictures"),
    "render": ("commands.render", "Draw a person in a pose"),
    "export": ("commands.export", "Write a person for other programs: .glb, .obj or .ply"),
    "merge": ("commands.merge", "Write people as one grid of voxels: .vdb or .npz"),
    "info": ("commands.info", "Say what this installation, a checkpoint or a person is, as JSON"),
    "people": ("commands.people", "Make dressed, rigged people (glTF) from a MakeHuman asset folder"),
    "payloads": ("payloads_command", "Make such people, or captured ones, as primitives to train on; pack them"),
    "captures": ("commands.captures", "Pictures of such people from many sides: render, verify, info, pack, sheet"),
    "fit": ("training.fit_command", "Train the encoder on captures: from pictures to primitives"),
    "train": ("training.diffuse", "Train the diffusion model on such primitives"),
    "evaluate": ("commands.evaluate", "Measure how good trained models are"),
    "import-released": (
        "commands.import_released",
        "Turn the authors' primdiffusion.pt and your SMPL file into a checkpoint",
    ),
}
"""The module of each command, whose `run` takes a line's further words. Several take a second to import, so only the
one that is asked for is."""


def help_text() -> str:
    """What commands there are."""
    lines = [f"  {name:<16} {about}" for name, (_, about) in COMMANDS.items()]
    return f"""usage: primdiffusion COMMAND ...

PrimDiffusion {__version__}: people as 1024 small volumes, from noise to pictures.

commands (each has its own --help):
{chr(10).join(lines)}

{TRACEBACK}, anywhere on the line, shows where an error came from."""


def run(arguments: Sequence[str]) -> None:
    """Runs one command line, errors as exceptions; wrong usage ends the process."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(help_text())
        return
    name = arguments[0]
    if name not in COMMANDS:
        print(f"primdiffusion: there is no command {name!r}: choose from {', '.join(COMMANDS)}", file=sys.stderr)
        sys.exit(USAGE)
    importlib.import_module(f"primdiffusion.{COMMANDS[name][0]}").run(arguments[1:])


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
