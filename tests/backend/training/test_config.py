"""Which settings a resumed run may change, and how a launcher passes the run's folder on."""

from __future__ import annotations

import pytest
import tyro
from diffuse_runs import settings
from primdiffusion.training.config import PriorConfig, TrainingConfig, check_resumable, to_json
from primdiffusion.training.fit_config import FitConfig
from support.errors import refused


def test_other_settings_are_rejected_and_other_limits_are_not(people, tmp_path):
    saved = to_json(settings(people, tmp_path))
    check_resumable(saved, settings(people, tmp_path / "moved", minutes=3.0))
    with refused(ValueError, "prior.components"):
        check_resumable(saved, settings(people, tmp_path, prior=PriorConfig(components=7)))


@pytest.mark.parametrize("config", [TrainingConfig, FitConfig])
def test_the_folder_has_a_second_name_that_torchrun_does_not_take_for_its_own(config, tmp_path):
    launcher = pytest.importorskip("torch.distributed.run").get_args_parser()
    for name in ("--run", "--run-folder"):
        assert tyro.cli(config, args=["--data", "people", name, str(tmp_path)]).run == tmp_path
    command = ["--data", "people", "--run-folder", str(tmp_path)]
    assert launcher.parse_args(["-m", "primdiffusion", *command]).training_script_args == command
