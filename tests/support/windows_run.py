"""Run tests of files, captures and the child under Windows' rules (`windows_rules`), in a process of their own."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
UNDER_THE_RULES = (
    "tests/support/windows_rules_hold.py",
    "tests/backend/files",
    "tests/backend/formats",
    "tests/contract/test_capture_layout.py",
    "tests/contract/test_client.py",
    "tests/contract/test_drawing_child.py",
    "tests/backend/capture/test_render.py::test_captures_have_the_layouts_files_and_are_whole",
    "tests/backend/capture/test_render.py::test_of_an_unfinished_subject_what_is_there_is_kept_and_what_is_missing_is_made",
)
TOO_LONG = ("many_deaths", "a_poll_ends", "heartbeats", "silence")
"""They pass too, but wait for a minute, and touch no files that the others do not."""


def run_under_the_rules(*options: str, tests: tuple[str, ...] = UNDER_THE_RULES) -> subprocess.CompletedProcess[str]:
    """Run pytest with the rules and these options; its output is in `stdout`."""
    command = [sys.executable, "-X", "warn_default_encoding", "-m", "pytest", "-p", "support.windows_rules"]
    left_out = " and ".join(f"not {name}" for name in TOO_LONG)
    always = ["-q", "-p", "no:cacheprovider", "-m", "not slow and not gpu and not unix", "-k", left_out]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST")}
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT / "backend"), str(ROOT), str(ROOT / "tests")])
    return subprocess.run(
        [*command, *always, *options, *tests],
        cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, encoding="utf-8", check=False,
    )  # fmt: skip
