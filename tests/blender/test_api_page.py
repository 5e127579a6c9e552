"""docs/manual/api.md tells of what is registered, and of nothing else."""

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "scripts" / "operators_page"))

import page  # noqa: E402

pytestmark = pytest.mark.any_blender

PAGE = ROOT / "docs" / "manual" / "api.md"


def test_the_page_is_what_its_script_writes_now(addon):
    current = PAGE.read_text(encoding="utf-8") == page.page()
    assert current, "docs/manual/api.md is out of date: run `python scripts/operators_page`"


def test_the_page_states_when_an_operator_is_disabled(addon):
    vary = page.page().split("\n### vary\n")[1].split("\n### ")[0]
    assert "tooltip says: There is no" in vary
