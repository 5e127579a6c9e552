"""How many people `primdiffusion people` makes a second on this machine.

`python benchmarks/people_speed.py --assets DIR --count 32 --workers 2 --json F`. Start-up (processes, imports, decoding
of the pack's pictures) is left out of `people_per_second` and told as `seconds_start`: it is the same for 8 people as
for 800. The figure for 16 cores is this machine's, multiplied; it was not measured there.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

from primdiffusion.people.assets import Assets, open_assets
from primdiffusion.people.folder import PeopleSet, make_people
from primdiffusion.people.wardrobe import required_meshes
from record import tell

WARM = 4
"""People that each worker makes before the clock starts."""


def people_per_second(count: int, workers: int, assets: Assets | None = None) -> float:
    """Measured on this machine, once its workers run: `count` people more than the first WARM of each."""
    return measure(count, workers, assets)["people_per_second"]


def measure(count: int, workers: int, assets: Assets | None = None) -> dict[str, float]:
    """Figures by name; makes count + WARM * workers people in a folder that is removed."""
    assets = assets or open_assets(None, required_meshes())
    first = WARM * workers
    with tempfile.TemporaryDirectory() as folder:
        begin = time.perf_counter()
        making = make_people(assets, PeopleSet(Path(folder), 0, count + first), workers)
        moments = [(done, time.perf_counter()) for done in making]
    started = next(moment for done, moment in moments if done >= first)
    rate = count / (moments[-1][1] - started)
    return {
        "people_per_second": rate,
        "people_per_second_16_cores_extrapolated": 16 * rate / workers,
        "seconds_a_person_a_core": workers / rate,
        "seconds_start": started - begin,
        "workers": workers,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--assets", type=Path, help="MakeHuman asset folder (or PRIMDIFFUSION_ASSETS)")
    parser.add_argument("--count", type=int, default=32)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--json", type=Path, help="file for the figures")
    arguments = parser.parse_args()
    assets = open_assets(arguments.assets, required_meshes())
    tell(measure(arguments.count, arguments.workers, assets), arguments.json)


if __name__ == "__main__":
    main()
