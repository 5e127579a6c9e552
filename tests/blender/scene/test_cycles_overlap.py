"""The count of volumes that overlap follows the shape."""

from __future__ import annotations

import json

import bpy
import numpy as np
import pytest
import synthetic_shape

from blender_primdiffusion.scene import cycles
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.cycles import current_overlap, max_overlap, overlap_warning
from blender_primdiffusion.scene.edit import reshape
from blender_primdiffusion.scene.human import MARK, parts_of
from blender_primdiffusion.scene.rest_human import read_human
from blender_primdiffusion.scene.shape import generated_betas
from blender_primdiffusion.ui.advanced_panel import details

pytestmark = pytest.mark.usefixtures("volumes_shown")

COUNT = 96
SMALL = (-4.0, -4.0, -4.0)
"""The first betas, by which all shrinks."""


@pytest.fixture
def source(tmp_path):
    return synthetic_shape.write(tmp_path / "human", COUNT)


@pytest.fixture
def person(saved_scene, source):
    return build_human(saved_scene, source)


def small(person) -> np.ndarray:
    return np.concatenate([SMALL, generated_betas(person)[len(SMALL) :]])


def counted(source, betas) -> int:
    """From the file alone."""
    human = read_human(source)
    rest, growth = human.model.rest(betas), human.model.growth(human.payload.betas, betas)
    offset, half = human.grids().drawn_box()
    return max_overlap(
        rest.position + np.einsum("kij,kj->ki", rest.rotation, growth * offset), rest.rotation, growth * half
    )


def test_the_count_is_that_of_the_shape_of_now(person, source):
    bpy.context.view_layer.update()
    noted = json.loads(person[MARK])["most_overlapping"]
    assert current_overlap(person) == noted == counted(source, generated_betas(person))
    reshape(person, small(person))
    bpy.context.view_layer.update()
    expected = counted(source, small(person))
    assert expected > noted
    assert current_overlap(person) == expected
    assert ("Volumes", f"{COUNT}, up to {current_overlap(person)} overlap") in details(person)
    reshape(person, generated_betas(person))
    assert current_overlap(person) == noted


def test_volumes_are_counted_once_for_each_shape(person, monkeypatch):
    asked = []
    monkeypatch.setattr(cycles, "max_overlap", lambda *boxes: asked.append(boxes) or 50)
    reshape(person, small(person))
    bpy.context.view_layer.update()
    assert "50 volumes overlap" in overlap_warning(person)
    assert "50 volumes overlap" in overlap_warning(person)
    assert len(asked) == 1
    reshape(person, small(person) + 0.5)
    bpy.context.view_layer.update()
    assert current_overlap(person) == 50
    assert len(asked) == 2


def test_volumes_that_blender_has_not_read_are_not_read_to_be_counted(person, monkeypatch):
    reshape(person, small(person))
    next(obj for obj in parts_of(person) if obj.type == "VOLUME").hide_viewport = True
    bpy.context.view_layer.update()
    monkeypatch.setattr(cycles, "max_overlap", lambda *_: 1 / 0)
    assert current_overlap(person) == json.loads(person[MARK])["most_overlapping"]


def test_volumes_whose_files_are_missing_are_not_counted(person):
    noted = json.loads(person[MARK])["most_overlapping"]
    reshape(person, small(person))
    volume = next(obj.data for obj in parts_of(person) if obj.type == "VOLUME")
    volume.filepath = "//nowhere/prim_0000.vdb"
    bpy.context.view_layer.update()
    assert current_overlap(person) == noted


def test_a_note_changed_by_hand_is_no_warning(person):
    person[MARK] = "nothing"
    assert overlap_warning(person) is None
