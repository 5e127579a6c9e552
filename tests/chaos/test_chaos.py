"""A short form of `make chaos`."""

import os
import sys

import pytest
import torch
from chaos.attack import Attack, Outcome
from chaos.forks import forking
from chaos.kills import Tally
from chaos.results import finished, half_written, set_back
from chaos.surroundings import broken_environment, try_broken
from safetensors.torch import save_file
from support.errors import refused

QUICK = ("captures pack", "serve merge")

pytestmark = pytest.mark.skipif(os.name == "nt", reason="needs fork and SIGKILL")


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    with forking() as forks:
        yield Attack(tmp_path_factory.mktemp("chaos"), forks, 0, QUICK)


@pytest.fixture
def attack(prepared):
    prepared.outcome = Outcome()
    return prepared


@pytest.mark.parametrize("name", QUICK)
def test_a_killed_program_that_is_run_again_loses_nothing(attack, name):
    (program,) = (one for one in attack.programs if one.name == name)
    attack.kill(program)
    assert attack.outcome.kills.wrong == []


def test_a_result_that_a_kill_sets_back_is_found(tmp_path):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    for folder, steps in ((whole, 3), (killed, 2)):
        folder.mkdir()
        (folder / "a.txt").write_text("a")
        save_file({"a": torch.zeros(1)}, folder / "person.state.safetensors", {"step": str(steps)})
        (folder / "metrics.jsonl").write_text("{}\n")
    before = finished(killed, whole)
    assert before == {"a.txt": 1, "person.state.safetensors": 2}
    (killed / "a.txt").write_text("b")
    save_file({"a": torch.zeros(1)}, killed / "person.state.safetensors", {"step": "1"})
    assert set_back(before, finished(killed, whole)) == ["a.txt was lost", "person.state.safetensors was lost"]
    assert set_back(before, before) == []
    (killed / "person.state.safetensors").write_bytes(b"half")
    assert half_written(killed) == ["person.state.safetensors"]
    assert finished(killed, whole)["person.state.safetensors"] == 0


def test_an_unknown_program_is_named(tmp_path):
    with refused(ValueError, "train-nothing"):
        Attack(tmp_path, None, 0, ["train-nothing"])  # type: ignore[arg-type]


@pytest.mark.parametrize("name", QUICK)
def test_a_full_disk_ends_in_one_sentence_and_half_writes_nothing(attack, name):
    (program,) = (one for one in attack.programs if one.name == name)
    attack.fill(program)
    assert attack.outcome.disks.wrong == []
    assert name in attack.outcome.filled


def test_the_client_outlives_deaths_and_silence_of_its_child(attack):
    attack.children(2)
    assert attack.outcome.children.wrong == []
    assert attack.outcome.child_hangs == 0


def test_an_odd_environment_is_no_traceback(attack):
    attack.environments(["help"])
    assert attack.outcome.environments.wrong == []


def test_a_broken_package_is_one_sentence(tmp_path):
    command, tally = [sys.executable, "-m", "primdiffusion", "info"], Tally()
    try_broken({"info": command}, broken_environment(tmp_path), tally)
    assert (tally.count, tally.wrong) == (1, [])
