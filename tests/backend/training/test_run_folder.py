"""The folder of a run."""

import diffuse_runs
import fit_scenes
import pytest
from primdiffusion.training.diffuse import train
from primdiffusion.training.fit import fit
from primdiffusion.training.run_folder import lock_folder
from support.errors import refused


@pytest.mark.parametrize(
    "start",
    [
        lambda data, run: train(diffuse_runs.settings(data, run)),
        lambda data, run: fit(fit_scenes.settings(data, run)),
    ],
    ids=["train", "fit"],
)
def test_a_second_run_in_a_folder_is_rejected(tmp_path, start):
    run = tmp_path / "run"
    with lock_folder(run), refused(ValueError, "another process"):
        start(tmp_path / "data", run)
