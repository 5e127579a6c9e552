"""A short form of `make chaos`."""

import os

import pytest
from chaos.attack import Attack, Outcome
from chaos.child_deaths import Deaths
from chaos.forks import forking

QUICK = ("captures render", "captures pack", "captures sheet", "payloads pack")

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


def test_the_client_outlives_deaths_of_its_child(attack):
    attack.children(6)
    assert attack.outcome.children.wrong == []
    assert attack.outcome.child_hangs == 0


def test_a_silent_child_is_reported_and_replaced(tmp_path, attack):
    deaths = Deaths(tmp_path, attack.rng)
    deaths.works()
    deaths.stopped()
    deaths.works()
    deaths.end()
    assert (deaths.tally.wrong, deaths.hangs) == ([], 0)


def test_a_broken_package_or_an_odd_environment_is_no_traceback(attack):
    attack.environments(["info"])
    assert attack.outcome.environments.wrong == []
