"""Measures how many people per second `primdiffusion people` makes on this machine.

`python benchmarks/people_speed.py --assets DIR --count 32 --workers 2 --json F`. Start-up (processes, imports, decoding
the assets' pictures) is not part of `people_per_second`; it is recorded as `seconds_start`, because it does not depend
on the number of people. The figure for 16 cores is extrapolated from this machine.
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
"""People that each worker makes before timing starts."""


def people_per_second(count: int, workers: int, assets: Assets | None = None) -> float:
    """People per second on this machine, from `count` people after the first WARM of each worker."""
    return measure(count, workers, assets)["people_per_second"]


def measure(count: int, workers: int, assets: Assets | None = None) -> dict[str, float]:
    """Figures by name; makes count + WARM * workers people in a temporary folder."""
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
