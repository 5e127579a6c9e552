"""The private environment: real venv, pip and hash checks on tiny wheels, in a process of its own."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import sys
from pathlib import Path

import psutil
import pytest
from tiny_packages import BACKEND, own_index, served, until, write_lock, write_packages, write_wheel
from worker import setup_steps
from worker.environment import VARIABLE, candidates
from worker.setup_folder import SetUpFolder, state_of
from worker.setup_group import guarded
from worker.setup_job import CANCELLED, SetUpJob
from worker.setup_steps import OFFLINE, Plan


@pytest.fixture
def plan(tmp_path, monkeypatch) -> Plan:
    """From a folder of wheels, into a folder with a space and an umlaut."""
    monkeypatch.delenv(VARIABLE, raising=False)
    own_index(monkeypatch)
    lock = write_lock(tmp_path / "lock.txt", write_packages(tmp_path / "räder"))
    root = tmp_path / "Menschen für Blender"
    return Plan(sys.executable, str(root), str(BACKEND), str(root / "cache"), str(lock), str(tmp_path / "räder"), "cpu")


def done(kind, plan: Plan) -> SetUpJob:
    """Seen through to its end."""
    job = SetUpJob(kind, plan)
    job.start()
    until(lambda: job.tick() and job.finished)
    return job


def refused(kind, plan: Plan) -> str:
    """The sentence of a set-up that fails."""
    job = done(kind, plan)
    assert job.state == "failed", job.message
    return job.message


def test_an_environment_is_made_of_a_folder_of_wheels_tried_and_marked_ready(plan):
    job = done("set_up", plan)
    assert job.state == "done", f"{job.message}\n{job.log.read_text()}"
    assert job.message.startswith("The backend is ready: torch 0-tiny on tiny device")
    state, about = state_of(plan.folder)
    assert state == "ready"
    assert (about["packages"], about["compute"], about["device"]) == (2, "cpu", "tiny device")
    assert about["bytes"] > 1000
    assert not plan.folder.wheels.exists()
    assert not plan.folder.temporary.exists()
    assert next(candidates(None, plan.folder.environment))[1] == plan.folder.python


def test_removing_takes_environment_and_caches_and_nothing_else(plan):
    assert done("set_up", plan).state == "done"
    kept = plan.folder.root / "somebody_elses"
    kept.touch()
    Path(plan.cache, "bytecode").mkdir(parents=True, exist_ok=True)
    job = done("remove", plan)
    assert job.state == "done", job.message
    assert state_of(plan.folder)[0] == "absent"
    assert not Path(plan.cache).exists()
    assert kept.exists()


def test_removing_without_a_cache_to_remove_takes_the_rest(plan, tmp_path, monkeypatch):
    (tmp_path / "working directory").mkdir()
    monkeypatch.chdir(tmp_path / "working directory")  # which an empty path means
    plan.folder.wheels.mkdir(parents=True)
    plan = dataclasses.replace(plan, cache="")
    assert done("remove", plan).state == "done"
    assert not plan.folder.wheels.exists()
    assert Path.cwd().exists()


def test_repair_finds_a_damaged_file_and_mends_it(plan):
    assert done("set_up", plan).state == "done"
    assert done("repair", plan).message.startswith("Nothing had to be repaired")
    module = next(plan.folder.environment.rglob("tiny.py"))
    good = module.read_bytes()
    module.write_text("PROBLEM = None  # and more")
    job = done("repair", plan)
    assert job.state == "done", job.message
    assert job.message.startswith("The backend is ready")
    assert next(plan.folder.environment.rglob("tiny.py")).read_bytes() == good


def test_a_wheel_that_is_not_the_locked_one_is_refused_and_nothing_is_ready(plan, tmp_path, monkeypatch):
    write_wheel(tmp_path / "räder", "torch", "__version__ = 'evil'\n")
    said = refused("set_up", plan)
    assert "lacks the right wheels of torch 1.0" in said
    with served(tmp_path / "räder") as (index, _):
        own_index(monkeypatch, index)
        said = refused("set_up", dataclasses.replace(plan, offline=""))
    assert said.startswith("The downloaded file of torch is not the right one (its hash differs)")
    assert state_of(plan.folder)[0] == "half"
    assert not list(plan.folder.environment.rglob("torch.py"))


@pytest.fixture
def two_groups(plan, tmp_path) -> Plan:
    """Each wheel counts as large, so each is fetched by a run of its own."""
    wheels = sorted((tmp_path / "räder").glob("*.whl"))
    write_lock(Path(plan.lock), wheels, setup_steps.GROUP_BYTES)
    return dataclasses.replace(plan, offline="")


def test_a_cancel_ends_pip_at_once_and_the_next_try_fetches_only_what_is_missing(two_groups, tmp_path, monkeypatch):
    plan = two_groups
    with served(tmp_path / "räder", stalls="torch") as (index, handler):
        own_index(monkeypatch, index)
        job = SetUpJob("set_up", plan)
        job.start()
        until(lambda: job.tick() is None or any(path.startswith("/torch-") for path in handler.asked))
        assert "package 2 of 2" in job.message or job.fraction > 0
        group = psutil.Process(job._process.pid)
        processes = [group, *group.children(recursive=True)]
        assert len(processes) > 1
        job.cancel()
        assert (job.state, job.message) == ("cancelled", CANCELLED)
        until(lambda: not any(_alive(process) for process in processes), 5.0)
    assert state_of(plan.folder)[0] == "half"
    assert [wheel.name for wheel in plan.folder.wheels.glob("*.whl")] == ["tiny-1.0-py3-none-any.whl"]
    with served(tmp_path / "räder") as (index, handler):
        own_index(monkeypatch, index)
        assert done("set_up", plan).state == "done"
        assert [path for path in handler.asked if path.endswith(".whl")] == ["/torch-1.0-py3-none-any.whl"]


def _alive(process: psutil.Process) -> bool:
    try:
        return process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def test_a_set_up_ends_with_the_blender_that_wanted_it(two_groups, tmp_path, monkeypatch):
    with served(tmp_path / "räder", stalls="torch") as (index, handler):
        own_index(monkeypatch, index)
        job = SetUpJob("set_up", two_groups)
        job.start()
        until(lambda: any(path.startswith("/torch-") for path in handler.asked))
        job._process.stdin.close()  # as the system does for a process that is gone
        until(lambda: job.tick() and job.finished, 10.0)
    assert job.state == "failed"


def test_a_half_installed_environment_is_recognised_and_not_used(plan):
    assert done("set_up", plan).state == "done"
    (plan.folder.environment / "ready.json").unlink()
    (plan.folder.environment / "unfinished").touch()
    assert state_of(plan.folder)[0] == "half"
    assert [source for source, _ in candidates(None, plan.folder.environment)] == ["Blender's own Python"]


def test_an_environment_whose_blender_is_gone_is_recognised(plan, tmp_path):
    assert done("set_up", plan).state == "done"
    marker = plan.folder.environment / "ready.json"
    marker.write_text(json.dumps({**json.loads(marker.read_text()), "base": str(tmp_path / "old blender/python")}))
    assert state_of(plan.folder)[0] == "moved"


def test_an_environment_that_fails_its_self_test_is_not_ready(plan, tmp_path):
    wheels = write_packages(tmp_path / "räder", problem="the graphics card is on fire")
    write_lock(Path(plan.lock), wheels)
    assert refused("set_up", plan) == "The self-test failed: the graphics card is on fire."
    assert state_of(plan.folder)[0] == "half"


def test_another_python_can_be_tried_alone(plan, tmp_path):
    shutil.rmtree(plan.root, ignore_errors=True)
    said = refused("self_test", dataclasses.replace(plan, python=str(tmp_path / "no-python")))
    assert "no-python (the extension's preferences) does not exist" in said
    assert done("set_up", plan).state == "done"
    assert done("self_test", dataclasses.replace(plan, python=str(plan.folder.python))).state == "done"


def test_no_network_is_a_sentence(two_groups, monkeypatch):
    own_index(monkeypatch)
    assert refused("set_up", two_groups).startswith("The package index cannot be reached: check the network")


def test_no_online_access_is_a_sentence_also_where_repairing_needs_it(two_groups):
    said = refused("repair", dataclasses.replace(two_groups, online=False))
    assert said == f"2 packages have to be downloaded: {OFFLINE}."


def test_too_little_disk_is_said_before_anything_is_made(plan, tmp_path):
    write_lock(Path(plan.lock), list((tmp_path / "räder").glob("*.whl")), 10**16)
    assert "GB are needed: free some space" in refused("set_up", plan)
    assert not plan.folder.environment.exists()


@pytest.mark.skipif(os.name == "nt", reason="shell scripts")
@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("echo 3.9", "is Python 3.9, and 3.11 or newer is needed"),
        ("exit 3", "is no Python that can be run"),
        (
            'case "$*" in *venv*|*pip*) echo "No module named venv"; exit 1;; *) echo 3.11;; esac',
            "sudo apt install python3-venv",
        ),
    ],
)
def test_a_python_that_cannot_make_an_environment_is_told_so(plan, tmp_path, text, said):
    host = tmp_path / "host"
    host.write_text(f"#!/bin/sh\n{text}\n")
    host.chmod(0o755)
    steps = setup_steps.set_up(dataclasses.replace(plan, host=str(host)), (tmp_path / "log").open("w"))
    with pytest.raises(setup_steps.SetUpFailed, match=said):
        list(steps)
    assert state_of(plan.folder)[0] == "half"


@pytest.mark.skipif(os.name == "nt", reason="shell scripts")
@pytest.mark.parametrize(
    ("lacks", "words"), [("ensurepip", "*without-pip*) ;; *'-m venv'*"), ("pip of its own", "*'-m pip'*")]
)
def test_either_ensurepip_or_a_pip_of_the_hosts_own_is_enough(plan, tmp_path, lacks, words):
    host = tmp_path / "host"
    refusal = f'case "$*" in {words}) echo "there is no {lacks}"; exit 1;; esac'
    host.write_text(f'#!/bin/sh\n{refusal}\nexec "{sys.executable}" "$@"\n')
    host.chmod(0o755)
    with (tmp_path / "log").open("w") as log:
        last = list(setup_steps.set_up(dataclasses.replace(plan, host=str(host)), log))[-1]
    assert last.result["packages"] == 2


def test_two_blenders_do_not_set_up_the_same_folder(plan):
    plan.folder.root.mkdir(parents=True)
    with guarded(plan.folder.guard):
        assert refused("set_up", plan).startswith("Another Blender is setting up the backend in")
    assert not plan.folder.environment.exists()


def test_a_damaged_list_of_packages_is_a_sentence(plan):
    Path(plan.lock).write_text("torch\n")
    assert "is not 'name==version --hash=sha256:...': 'torch'" in refused("set_up", plan)
    assert not SetUpFolder(Path(plan.root)).environment.exists()


def test_a_very_long_path_holds_an_environment(plan, tmp_path):
    if os.name == "nt":
        pytest.skip("there the environment goes to a short folder instead")
    root = tmp_path.joinpath(*["sehr lange"] * 24)
    assert len(str(root)) > 260
    assert done("set_up", dataclasses.replace(plan, root=str(root))).state == "done"
