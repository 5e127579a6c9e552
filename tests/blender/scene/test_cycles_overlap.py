"""The count of volumes that overlap."""

from __future__ import annotations

import json

import numpy as np
import pytest
import synthetic_shape

from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.cycles import overlap_of, overlap_warning
from blender_primdiffusion.scene.human import MARK
from blender_primdiffusion.scene.human_file import read_human
from blender_primdiffusion.scene.shape import generated_betas
from blender_primdiffusion.scene.volumes import max_overlap
from blender_primdiffusion.ui.advanced_panel import details

COUNT = 96


@pytest.fixture
def source(tmp_path):
    return synthetic_shape.write(tmp_path / "human", COUNT)


@pytest.fixture
def person(saved_scene, source):
    return build_human(saved_scene, source)


def counted(source, betas) -> int:
    """From the file alone."""
    human = read_human(source)
    rest, growth = human.model.rest(betas), human.model.growth(human.payload.betas, betas)
    offset, half = human.grids().drawn_box()
    return max_overlap(
        rest.position + np.einsum("kij,kj->ki", rest.rotation, growth * offset), rest.rotation, growth * half
    )


def test_the_count_is_that_of_the_boxes_as_they_were_made(person, source):
    noted = json.loads(person[MARK])["most_overlapping"]
    assert overlap_of(person) == noted == counted(source, generated_betas(person))
    assert ("Volumes", f"up to {noted} overlap") in details(person)


def test_a_note_changed_by_hand_is_no_warning(person):
    person[MARK] = "nothing"
    assert overlap_warning(person) is None
