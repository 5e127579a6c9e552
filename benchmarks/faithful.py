"""How exactly the released networks, their import and the paper's metrics are reproduced.

`python benchmarks/faithful.py --json docs/results/faithful.json` writes one flat object in about two minutes. The
references are those of the tests: second implementations in float64 (`unet_error_max`, `attention_twin_error_max`,
`stage1_error_max`: largest difference relative to the largest output, of random weights), a file of 475 tensors of the
released names and shapes (`importer_unaccounted`: tensors without an entry in its report), torch-fidelity 0.4.0
(`fid_equal_error`: relative), and joints at known distances (`pck_synthetic_error`).

With `--assets DIR`, `table1_minutes_cpu_quick` is the time of `primdiffusion evaluate generation` with one
human in two poses from four sides; without, it is null, because it takes minutes.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from record import command_line, report

ROOT = Path(__file__).resolve().parents[1]
TESTS = ROOT / "tests"
sys.path[:0] = [
    str(TESTS / folder) for folder in (".", "backend", "backend/released", "backend/evaluation", "backend/diffusion")
]  # the references

import test_metrics_torch_fidelity  # noqa: E402
import test_pose_depth_network  # noqa: E402
import test_stage_one_twin  # noqa: E402
import test_unet_twin  # noqa: E402
import torch  # noqa: E402
from primdiffusion.diffusion.unet import PAPER, SlabUNet  # noqa: E402
from primdiffusion.released.inventory import take_inventory  # noqa: E402
from released_files import blank, state, template  # noqa: E402

QUICK = ("--count", "1", "--poses", "2", "--views", "4")
"""The fewest pictures of which there is a table."""


def unaccounted() -> int:
    """Number of the 475 tensors of a file of the released shapes that the importer's report does not name."""
    with torch.device("meta"):
        shapes = {name: tuple(value.shape) for name, value in SlabUNet(PAPER).state_dict().items()}
    weights = state({name: blank(*shape) for name, shape in shapes.items()}, template())
    if len(weights) != 475:
        raise ValueError(f"the reference file has {len(weights)} tensors instead of 475")
    return len(weights.keys() - {entry.key for entry in take_inventory(weights).account.entries if entry.note})


def table_minutes(assets: Path) -> float:
    """Minutes to measure the paper's Table 1 on the CPU in the size of `QUICK`."""
    command = [sys.executable, "-m", "primdiffusion", "evaluate", "generation", "--device", "cpu"]
    began = time.perf_counter()
    subprocess.run([*command, "--assets", str(assets), *QUICK], check=True, env=dict(os.environ), cwd=ROOT)
    return (time.perf_counter() - began) / 60


def measure(assets: Path | None) -> dict[str, float | int | None]:
    """All figures; None means not measured here."""
    with tempfile.TemporaryDirectory() as folder:
        weights = test_metrics_torch_fidelity.save_random_inception(Path(folder) / "inception.pth")
        fid_error = test_metrics_torch_fidelity.fid_error(weights)
    return {
        "unet_error_max": max(map(test_unet_twin.unet_error, (test_unet_twin.PLAIN, test_unet_twin.ATTENTIVE))),
        "attention_twin_error_max": max(test_unet_twin.attention_error(), test_stage_one_twin.attention_error()),
        "stage1_error_max": test_stage_one_twin.stage_one_error(),
        "importer_unaccounted": unaccounted(),
        "fid_equal_error": fid_error,
        "pck_synthetic_error": test_pose_depth_network.pck_error(),
        "table1_minutes_cpu_quick": None if assets is None else round(table_minutes(assets), 2),
    }


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--assets", type=Path, help="MakeHuman's assets: measure the time of Table 1 too")
    arguments = parser.parse_args()
    report(measure(arguments.assets), arguments.json)


if __name__ == "__main__":
    main()
