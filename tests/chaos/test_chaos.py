"""A short form of `make chaos`."""

import os
import sys

import pytest
from chaos.attack import Attack, Outcome
from chaos.forks import forking
from chaos.kills import Tally
from chaos.surroundings import broken_environment, try_broken

QUICK = ("payloads pack", "serve merge")

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
