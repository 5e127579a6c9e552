"""Kill programs, fill disks and break environments: `python -m tests.chaos --minutes 30`.

Prints every fault, and the figures; the exit code is 1 if there is any fault. The same seed tries the same things, but
moments of kills are measured in seconds, so that their effects differ. `--attacks kills --kills 150 --only train fit`
kills these two 150 times, and does nothing else.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(TESTS / folder) for folder in ("..", ".", "backend", "contract", "blender")]

from chaos.attack import ATTACKS, Attack  # noqa: E402
from chaos.forks import forking  # noqa: E402
from chaos.programs import ASSETS, makehuman  # noqa: E402


def _report(what: str) -> None:
    print(what, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--minutes", type=float, default=10.0, help="of kills and all else; each is tried once at least"
    )
    parser.add_argument("--attacks", nargs="+", choices=ATTACKS, default=ATTACKS)
    parser.add_argument("--kills", type=int, default=0, help="end with so many, not with the minutes")
    parser.add_argument("--deaths", type=int, default=1000, help="of the child")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", default=(), help="names of programs, such as 'captures pack'")
    parser.add_argument("--json", type=Path, help="write the figures here")
    arguments = parser.parse_args()
    os.environ["PRIMDIFFUSION_CACHE"] = str(TESTS.parent / ".pytest_cache" / "children")
    if makehuman() is None:
        print(f"people and payloads are not tried: {ASSETS} names no MakeHuman asset folder", flush=True)
    with tempfile.TemporaryDirectory(prefix="primdiffusion_chaos_") as name, forking() as forks:
        try:
            attack = Attack(Path(name), forks, arguments.seed, arguments.only)
        except ValueError as error:
            parser.error(str(error))
        if "disks" in arguments.attacks and not attack.mounts:
            print("disks cannot be mounted here (root can): files are limited in size instead", flush=True)
        attack.everything(arguments.attacks, arguments.kills, arguments.minutes, arguments.deaths, _report)
    for sentence in attack.outcome.wrong:
        print(sentence)
    figures = attack.outcome.figures(arguments.attacks)
    print(json.dumps(figures, indent=2))
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    sys.exit(bool(attack.outcome.wrong))


if __name__ == "__main__":
    main()
