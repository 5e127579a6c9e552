"""Edits as the panel follows them, with the real child."""

import time
from pathlib import Path

import pytest
from child_requests import edit_request, generate_request, this_pythons_backend
from conversation import BUSY_STEPS
from primdiffusion.human_file import load_human

from blender_primdiffusion.backend.requests import ChildRequest

PART = {"region": ["hair"], "seed": 2}
PARAMS = {
    "vary": {"amount": 0.5, "seed": 3},
    "inpaint": {**PART, "attributes": {"outfit": "suit"}, "guidance": 2.0},
    "transfer": {**PART, "what": "garment", "harmonise": 0.5},
    "interpolate": {"fraction": 0.25},
}


def follow(request: ChildRequest, until=lambda request: request.finished, timeout_s: float = 120) -> ChildRequest:
    """Ticks as Blender's timer does."""
    end = time.monotonic() + timeout_s
    while not until(request):
        assert time.monotonic() < end, (request.state, request.message)
        request.tick()
        time.sleep(0.01)
    return request


@pytest.fixture(scope="module")
def backend():
    backend = this_pythons_backend()
    yield backend
    backend.shutdown()


@pytest.fixture(scope="module")
def people(backend, checkpoint, tmp_path_factory) -> list[Path]:
    folders = [tmp_path_factory.mktemp("people") / name for name in ("anna", "berta")]
    for seed, folder in enumerate(folders):
        request = follow(generate_request(backend, seed=seed, steps=1, out_dir=folder, checkpoint=checkpoint))
        assert request.state == "done", request.message
    return [folder / "person.human.safetensors" for folder in folders]


def edit(backend, people, checkpoint, method, out, steps=3, **changes) -> ChildRequest:
    others = {"transfer": {"source": str(people[1])}, "interpolate": {"other": str(people[1])}}
    asked = {**PARAMS[method], **others.get(method, {}), **changes}
    return edit_request(backend, method, people[0], **asked, out_dir=out, steps=steps, checkpoint=checkpoint)


@pytest.mark.parametrize("method", PARAMS)
def test_an_edit_takes_steps_and_leaves_another_person(backend, people, checkpoint, tmp_path, method):
    steps = []
    request = edit(backend, people, checkpoint, method, tmp_path / "out")
    follow(request, lambda request: steps.append(request.step) or request.finished)
    assert request.state == "done", request.message
    assert request.fraction == 1.0
    before, after = load_human(people[0]), load_human(request.result.person)
    assert not before.payload.rgb.equal(after.payload.rgb)


def test_a_cancelled_edit_leaves_nothing(backend, people, slow_checkpoint, tmp_path):
    request = edit(backend, people, slow_checkpoint, "vary", tmp_path / "out", BUSY_STEPS, amount=1.0)
    follow(request, lambda request: request.step > 2)
    request.cancel()
    assert follow(request).state == "cancelled"
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"person": "nobody.human.safetensors"}, "nobody"),
        ({"amount": 2.0}, "amount is 2"),
        ({"seed": -1}, "seed is -1"),
    ],
)
def test_what_the_child_rejects_becomes_the_requests_error(backend, people, checkpoint, tmp_path, changes, named):
    wanted = {**PARAMS["vary"], **changes}
    person = Path(wanted.pop("person", people[0]))
    request = edit_request(backend, "vary", person, **wanted, out_dir=tmp_path / "out", steps=2, checkpoint=checkpoint)
    assert follow(request).state == "failed"
    assert named in request.error.message
    assert not (tmp_path / "out").exists()
