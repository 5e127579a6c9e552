"""Which settings a resumed run may change."""

from __future__ import annotations

from diffuse_runs import settings
from primdiffusion.training.config import PriorConfig, check_resumable, to_json
from support.errors import refused


def test_other_settings_are_rejected_and_other_limits_are_not(people, tmp_path):
    saved = to_json(settings(people, tmp_path))
    check_resumable(saved, settings(people, tmp_path / "moved", minutes=3.0))
    with refused(ValueError, "prior.components"):
        check_resumable(saved, settings(people, tmp_path, prior=PriorConfig(components=7)))
