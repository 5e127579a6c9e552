"""Edits of people with the real child: as the protocol promises them to anyone."""

import json
from pathlib import Path

import pytest
from primdiffusion.diffusion.checkpoint import default_checkpoint, load_checkpoint
from primdiffusion.diffusion.samplers import SAMPLERS as BACKENDS_SAMPLERS
from primdiffusion.editing.regions import parts_of, region_of
from primdiffusion.formats.requests import PARTS, SAMPLERS
from primdiffusion.human_file import load_human, save_human
from support import tiny
from support.errors import refused
from support.tiny import VOCABULARY, random_human

from blender_primdiffusion.ui.generate_settings import read_vocabulary

DOMAIN_ERROR, INVALID_PARAMS = -32002, -32602
RESULTS = ("person", "preview", "side", "depth")


@pytest.fixture(scope="module")
def people(tmp_path_factory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("people")
    paths = {name: str(folder / f"{name}.human.safetensors") for name in ("ann", "bob")}
    for seed, path in enumerate(paths.values(), 1):
        save_human(path, random_human(seed))
    return paths


@pytest.fixture
def asked(people, checkpoint, tmp_path) -> dict:
    """Parameters that all edits take."""
    out = str(tmp_path / "new" / "person ü")
    return {"person": people["ann"], "out_dir": out, "steps": 3, "checkpoint": str(checkpoint), "size": 32}


EDITS = {
    "vary": {"amount": 0.4, "seed": 7},
    "interpolate": {"other": "bob", "fraction": 0.25},
    "inpaint": {"region": ["top"], "seed": 7, "attributes": {"outfit": "suit"}, "guidance": 2.0, "masking": "released"},
    "transfer": {"source": "bob", "region": ["top", "left_foot"], "harmonise": 0.4, "seed": 7},
}


def parameters(method, people) -> dict:
    return {
        name: people.get(value, value) if isinstance(value, str) else value for name, value in EDITS[method].items()
    }


@pytest.mark.parametrize("method", EDITS)
def test_an_edit_reports_its_steps_and_leaves_whole_files(child, people, asked, method):
    child.send(1, method, **asked, **parameters(method, people))
    reports = []
    while "method" in (message := child.until(lambda m: m.get("method") == "progress" or m.get("id") == 1)):
        reports.append(message["params"])
    assert [stage["stage"] for stage in reports if stage["stage"] != "sample"] == ["load", "write", "write"]
    sampled = [(stage["step"], stage["total"]) for stage in reports if stage["stage"] == "sample"]
    assert [step for step, _ in sampled] == list(range(len(sampled)))
    assert sampled[-1][0] == sampled[-1][1], "the last step is the total"
    result = message["result"]
    for name in RESULTS:
        assert Path(result[name]).parent == Path(asked["out_dir"])
        assert Path(result[name]).stat().st_size > 0
    assert result["steps"] == 3
    assert result.get("seed") == EDITS[method].get("seed")
    assert result["seconds"] > 0
    edits = load_human(result["person"]).provenance["edits"]
    assert edits[0]["edit"].startswith(method)
    assert not list(Path(asked["out_dir"]).glob(".*"))


def test_attributes_tells_what_generate_can_be_asked_for(child, checkpoint):
    known = child.ask(6, "attributes", checkpoint=str(checkpoint))["result"]
    assert known == VOCABULARY.to_json()


def test_every_part_of_the_body_is_a_region():
    assert set(PARTS) == set(parts_of(None))
    assert len(PARTS) <= 32, "Blender's menu of several choices holds 32 bits"
    assert all(region_of([part]).any() for part in PARTS)


def test_samplers_are_the_backends():
    assert set(SAMPLERS) == set(BACKENDS_SAMPLERS)


def test_the_card_of_a_checkpoint_tells_what_its_model_knows(checkpoint):
    read = read_vocabulary(checkpoint)
    assert (read.categories, read.scalars) == (tiny.VOCABULARY.categories, tiny.VOCABULARY.scalars)


def test_the_default_checkpoint_is_read_as_the_backend_reads_it():
    model = load_checkpoint()
    read = read_vocabulary(Path(default_checkpoint()))
    assert (read.categories, read.scalars) == (model.vocabulary.categories, model.vocabulary.scalars)


def test_means_that_no_quantity_has_are_rejected(tmp_path):
    vocabulary = {"categories": {}, "scalars": {"height": [1e300, 0.1]}}
    header = json.dumps({"__metadata__": {"architecture": json.dumps({"vocabulary": vocabulary})}}).encode()
    path = tmp_path / "a.safetensors"
    path.write_bytes(len(header).to_bytes(8, "little") + header)
    with refused(ValueError, "a.safetensors"):
        read_vocabulary(path)
