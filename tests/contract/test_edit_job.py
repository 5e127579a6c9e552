"""Edits as the panel follows them, with the real child."""

import time
from pathlib import Path

import pytest
from child_jobs import edit_job, generate_job, this_pythons_backend
from conversation import BUSY_STEPS
from primdiffusion.human_file import load_human
from worker.job import Request

PART = {"region": ["hair"], "seed": 2}
PARAMS = {
    "vary": {"amount": 0.5, "seed": 3},
    "inpaint": {**PART, "attributes": {"outfit": "suit"}, "guidance": 2.0},
    "transfer": {**PART, "what": "garment", "harmonise": 0.5},
    "interpolate": {"fraction": 0.25},
}


def follow(job: Request, until=lambda job: job.finished, timeout_s: float = 120) -> Request:
    """Ticks as Blender's timer does."""
    end = time.monotonic() + timeout_s
    while not until(job):
        assert time.monotonic() < end, (job.state, job.message)
        job.tick()
        time.sleep(0.01)
    return job


@pytest.fixture(scope="module")
def backend():
    backend = this_pythons_backend()
    yield backend
    backend.shutdown()


@pytest.fixture(scope="module")
def people(backend, checkpoint, tmp_path_factory) -> list[Path]:
    folders = [tmp_path_factory.mktemp("people") / name for name in ("anna", "berta")]
    for seed, folder in enumerate(folders):
        job = follow(generate_job(backend, seed=seed, steps=1, out_dir=folder, checkpoint=checkpoint))
        assert job.state == "done", job.message
    return [folder / "person.human.safetensors" for folder in folders]


def edit(backend, people, checkpoint, method, out, steps=3, **changes) -> Request:
    others = {"transfer": {"source": str(people[1])}, "interpolate": {"other": str(people[1])}}
    asked = {**PARAMS[method], **others.get(method, {}), **changes}
    return edit_job(backend, method, people[0], **asked, out_dir=out, steps=steps, checkpoint=checkpoint)


@pytest.mark.parametrize("method", PARAMS)
def test_an_edit_takes_steps_and_leaves_another_person(backend, people, checkpoint, tmp_path, method):
    steps = []
    job = edit(backend, people, checkpoint, method, tmp_path / "out")
    follow(job, lambda job: steps.append(job.step) or job.finished)
    assert job.state == "done", job.message
    assert job.fraction == 1.0
    before, after = load_human(people[0]), load_human(job.result["person"])
    assert not before.payload.rgb.equal(after.payload.rgb)
    assert Path(job.result["human"]).is_file()


def test_a_cancelled_edit_leaves_nothing(backend, people, checkpoint, tmp_path):
    job = edit(backend, people, checkpoint, "vary", tmp_path / "out", BUSY_STEPS, amount=1.0)
    follow(job, lambda job: job.step > 2)
    job.cancel()
    assert follow(job).state == "cancelled"
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("changes", "named"),
    [({"person": "nobody.human.safetensors"}, "nobody"), ({"amount": 2.0}, "amount is 2"), ({"seed": -1}, "seed -1")],
)
def test_what_the_child_refuses_becomes_the_jobs_error(backend, people, checkpoint, tmp_path, changes, named):
    wanted = {**PARAMS["vary"], **changes}
    person = Path(wanted.pop("person", people[0]))
    job = edit_job(backend, "vary", person, **wanted, out_dir=tmp_path / "out", steps=2, checkpoint=checkpoint)
    assert follow(job).state == "failed"
    assert named in job.error.message
    assert not (tmp_path / "out").exists()
