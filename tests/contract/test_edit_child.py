"""What the panels offer is what the backend knows: attributes, regions and samplers."""

import json
from pathlib import Path

from primdiffusion.diffusion.checkpoint import default_checkpoint, load_checkpoint
from primdiffusion.diffusion.samplers import SAMPLERS as BACKENDS_SAMPLERS
from primdiffusion.editing.regions import parts_of, region_of
from primdiffusion.formats.requests import PARTS, SAMPLERS
from support import tiny
from support.errors import refused
from support.tiny import VOCABULARY

from blender_primdiffusion.ui.generate_settings import read_vocabulary


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
