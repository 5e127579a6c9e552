"""Files at the root of the checkout that repeat each other agree."""

import itertools
import json
import re
import runpy
import subprocess
import sys
import tomllib
from pathlib import Path
from unittest.mock import MagicMock

import pytest
from packaging.requirements import Requirement
from primdiffusion.files.regular_files import portable_name
from support.errors import refused
from support.fake_child import FAILS, FAKE_CHILD

from scripts.setup import TARGETS

ROOT = Path(__file__).resolve().parents[2]


def libraries(name: str) -> list[str]:
    return re.findall(r"\blib[a-z]+\d?(?:-\d+|\d+)\b", (ROOT / name).read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", ["README.md", "Dockerfile", ".github/workflows/ci.yml"])
def test_the_system_libraries_are_those_of_continuous_integration(name):
    assert len(libraries(".ci/run")) == 9
    assert libraries(name) == libraries(".ci/run")


def test_the_container_runs_the_commands_of_the_readme():
    commands = re.findall(r"^    make (\w+)", (ROOT / "README.md").read_text(encoding="utf-8"), re.MULTILINE)
    (run,) = re.findall(r"^CMD (.*)$", (ROOT / "Dockerfile").read_text(encoding="utf-8"), re.MULTILINE)
    assert json.loads(run) == ["make", *commands]


def test_the_citation_has_the_projects_version_and_licence():
    citation = dict(re.findall(r"^(\w+): (.+)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert (citation["version"], citation["license"]) == (project["version"], project["license"])


def test_every_requirement_has_an_exact_version_in_the_lock_that_its_range_allows():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = (ROOT / "requirements.lock").read_text(encoding="utf-8").splitlines()
    locked = dict(line.split("==") for line in lines if not line.startswith("#"))
    extras = [asked for name, asked in project["optional-dependencies"].items() if name != "bake"]
    # Tests replace wandb by a module of their own: the package brings twenty others.
    asked = [one for one in map(Requirement, itertools.chain(project["dependencies"], *extras)) if one.name != "wandb"]
    for requirement in asked:
        assert requirement.specifier.contains(locked[requirement.name]), requirement


def test_the_package_demands_no_exact_version():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert not [asked for asked in project["dependencies"] if "==" in asked]


def test_make_has_every_target_of_the_command_and_its_help_lists_them():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    (targets,) = re.findall(r"^TARGETS := (.*)$", makefile, re.MULTILINE)
    command = ["make", "--no-print-directory", "help"]
    printed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    listed = [line.split()[1] for line in printed.stdout.splitlines()]
    assert listed == targets.split()


def test_every_file_of_the_checkout_can_have_its_name_on_every_system():
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True)
    paths = [Path(line) for line in listed.stdout.splitlines()]
    assert len({str(path).lower() for path in paths}) == len(paths) > 0
    assert max(len(str(path)) for path in paths) < 120  # of the 259 that Windows allows
    for path in paths:
        assert all(part == portable_name(part) and not set(part) & set('<>:"\\|?*') for part in path.parts), path


def test_the_workflow_pins_its_actions_and_calls_targets_that_exist():
    workflow = (ROOT / ".github/workflows/ci.yml").read_text(encoding="utf-8")
    actions = re.findall(r"uses: (\S+)@(\S+)", workflow)
    assert len(actions) == 3
    assert all(re.fullmatch(r"[0-9a-f]{40}", version) for _, version in actions)
    assert {*re.findall(r"scripts\.setup ([\w.-]+)", workflow)} == {"lint", "demo", "test"} <= TARGETS.keys()


EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.mark.parametrize(
    ("script", "options", "files"),
    [
        ("generate_pose_render.py", ["--size", "48"], {"yaw_000.png", "yaw_270.png", "person.human.safetensors"}),
        ("fit_boxes.py", ["--size", "16", "--steps", "2"], {"fit.png", "gradients.png", "linear_solve.png"}),
        ("drive_the_child.py", ["--steps", "2"], {"person.human.safetensors", "front.png"}),
    ],
)
def test_an_example_leaves_its_files(script, options, files, checkpoint, tmp_path, monkeypatch):
    out = tmp_path / "out"
    words = [script, "--out", str(out), "--checkpoint", str(checkpoint), *options]
    monkeypatch.setattr(sys, "argv", words)
    monkeypatch.syspath_prepend(EXAMPLES)
    runpy.run_path(str(EXAMPLES / script), run_name="__main__")
    sys.modules.pop("walk", None)  # of the examples; the benchmarks have another
    assert files <= {path.name for path in out.iterdir()}


def test_the_page_is_served_to_this_machine_alone(checkpoint, monkeypatch):
    gradio = MagicMock()
    monkeypatch.setitem(sys.modules, "gradio", gradio)
    monkeypatch.setattr(sys, "argv", ["app.py", "--checkpoint", str(checkpoint)])
    runpy.run_path(str(EXAMPLES / "app.py"), run_name="__main__")
    page = gradio.Blocks.return_value.__enter__.return_value
    page.launch.assert_called_once_with(server_name="127.0.0.1", share=False)


def test_the_example_of_the_child_passes_its_sentence_on(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(FAKE_CHILD))
    monkeypatch.setattr(sys, "argv", ["drive_the_child.py", "--out", str(tmp_path / "out"), "--seed", str(FAILS)])
    with refused(SystemExit, "the checkpoint is damaged"):
        runpy.run_path(str(EXAMPLES / "drive_the_child.py"), run_name="__main__")
