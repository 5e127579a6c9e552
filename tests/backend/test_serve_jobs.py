"""The work of the child, without the child."""

import itertools

import pytest
from primdiffusion.serve import jobs
from primdiffusion.serve.jobs import Jobs
from primdiffusion.serve.params import GenerateParams
from tiny_model import save_tiny_checkpoint


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory) -> str:
    return str(save_tiny_checkpoint(tmp_path_factory.mktemp("checkpoint") / "tiny.safetensors"))


@pytest.fixture
def only_sampling(monkeypatch):
    """Leaves out files and pictures."""
    monkeypatch.setattr(jobs, "write_person", lambda *_: None)


def test_time_left_is_the_mean_of_the_warm_steps_times_the_steps_left(checkpoint, tmp_path, monkeypatch, only_sampling):
    clock = itertools.chain([0.0, 10.0, 12.0, 14.0, 20.0], itertools.count(30.0))  # start, 4 steps, the rest
    monkeypatch.setattr(jobs.time, "perf_counter", lambda: next(clock))
    reports = []
    Jobs().generate(GenerateParams(1, str(tmp_path), 4, checkpoint=checkpoint), lambda *report: reports.append(report))
    assert [report for report in reports if report[0] == "sample"] == [
        ("sample", 0, 4, None),
        ("sample", 1, 4, None),
        ("sample", 2, 4, 4.0),
        ("sample", 3, 4, 2.0),
        ("sample", 4, 4, 0.0),
    ]


def test_the_model_stays_loaded_until_another_is_asked_for(checkpoint, tmp_path, monkeypatch, only_sampling):
    loaded = []
    load = jobs.load_checkpoint
    monkeypatch.setattr(jobs, "load_checkpoint", lambda path, device: loaded.append(path) or load(path, device))
    other = str(save_tiny_checkpoint(tmp_path / "other.safetensors"))
    worker = Jobs()
    for path in (checkpoint, checkpoint, other, checkpoint):
        worker.generate(GenerateParams(1, str(tmp_path / "out"), 1, checkpoint=path), lambda *report: None)
    assert loaded == [checkpoint, other, checkpoint]


def test_a_job_can_be_ended_at_every_report(checkpoint, tmp_path):
    class Stop(Exception):
        pass

    params = GenerateParams(1, str(tmp_path / "out"), 2, checkpoint=checkpoint, size=32)
    reports = []
    Jobs().generate(params, lambda *report: reports.append(report))
    assert [report[0] for report in reports] == ["load", "sample", "sample", "sample", "write", "write"]
    for path in (tmp_path / "out").iterdir():
        path.unlink()
    (tmp_path / "out").rmdir()
    for end in range(len(reports)):
        count = itertools.count()

        def stop(*_, count=count, end=end):
            if next(count) == end:
                raise Stop

        with pytest.raises(Stop):
            Jobs().generate(params, stop)
        assert not (tmp_path / "out").exists()
