"""The folder of a run."""

import diffuse_runs
import fit_scenes
import pytest
from primdiffusion.files.folder_lock import lock_folder
from primdiffusion.files.regular_files import FileError
from primdiffusion.training.diffuse import train
from primdiffusion.training.fit import fit
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


@pytest.mark.parametrize("name", ["metrics.jsonl", "pictures", "tensorboard", ".lock"])
def test_nothing_is_written_through_a_link_in_a_strangers_run_folder(people, tmp_path, name, monkeypatch):
    diffuse_runs.make_small(monkeypatch)
    outside, run = tmp_path / "outside", tmp_path / "run"
    run.mkdir()
    if name in ("metrics.jsonl", ".lock"):
        outside.write_text("mine")
    else:
        outside.mkdir()
    (run / name).symlink_to(outside)
    with refused(FileError, name):
        train(diffuse_runs.settings(people, run))
    assert outside.read_text() == "mine" if outside.is_file() else not list(outside.iterdir())
