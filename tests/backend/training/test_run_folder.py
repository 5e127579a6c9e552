"""The folder of a run."""

import os

import diffuse_runs
import fit_scenes
import pytest
from primdiffusion.formats.whole_files import FolderInUseError, alone_in
from primdiffusion.training.diffuse import train
from primdiffusion.training.fit import fit


@pytest.mark.skipif(os.name == "nt", reason="Windows holds nothing")
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
    with alone_in(run), pytest.raises(FolderInUseError, match="another process works in"):
        start(tmp_path / "data", run)
