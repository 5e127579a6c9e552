"""Stage 1 learns: one person, whole pictures."""

import pytest
import torch
from capture_scenes import save_person
from fit_scenes import forget_processes, patched_person
from primdiffusion.capture.poses import built_in_poses
from primdiffusion.capture.render import RenderJob, render
from primdiffusion.formats.camera_rig import Rig
from primdiffusion.training.fit import fit
from primdiffusion.training.fit_config import FitConfig
from support.runs import rows


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_default_encoder_overfits_one_person_beyond_32_db(tmp_path):
    people = {"person_000000": save_person(tmp_path / "person.glb", patched_person())}
    poses = built_in_poses().map(lambda values: values[:2])
    job = RenderJob(people, poses, tmp_path / "captures", Rig("sphere", 12, width=256, height=256), ("img", "mask"))
    assert [outcome.status for outcome in render(job)] == ["done"]
    forget_processes()
    torch.manual_seed(0)
    config = FitConfig(
        data=job.out, run=tmp_path / "run", steps=150, batch=1,
        views=8, targets=4, size=192, conditioning_frame="first",
        learning_rate=1e-3, place_rate=1.0, hold_scale=20, ema=0.9, log_every=10, evaluate_every=25, pictures_every=75,
    )  # fmt: skip
    fit(config)
    psnr = [row["psnr_train"] for row in rows(config.run) if "psnr_train" in row]
    assert psnr[-1] >= 32, psnr  # 31.1 untrained
