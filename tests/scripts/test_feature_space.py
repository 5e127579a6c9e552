"""Generated humans compared with a reference set: cached portraits, detection of copies, the command."""

import json

import pytest
from diffusion_people import write_people
from primdiffusion.people.assets import open_assets
from primdiffusion.people.payloads import coloured_people, rest_frames
from primdiffusion.people.stored_people import find_payloads
from primdiffusion.primitives.from_mesh import colour, surface_field
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.training.latents import split_people
from support.errors import refused
from support.tiny import tiny_model

from scripts.feature_space import __main__ as command
from scripts.feature_space.comparison import COLUMNS, compare, open_reference_set, real_vs_real
from scripts.feature_space.portraits import (
    made_gallery,
    mesh_sources,
    open_gallery,
    payload_sources,
)
from scripts.train_attribute_network import accuracies, train_reference

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def assets():
    try:
        return open_assets()
    except FileNotFoundError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def people(tmp_path_factory):
    folder = tmp_path_factory.mktemp("people")
    write_people(folder, 6)
    return folder


@pytest.fixture(scope="module")
def reference_folder(tmp_path_factory):
    return tmp_path_factory.mktemp("judge")


@pytest.fixture(scope="module")
def reference(people, reference_folder):
    train, held = split_people(find_payloads(people), 0.34, 0)
    sources = [payload_sources(paths) for paths in (train, held)]
    train_reference(*sources, reference_folder)
    return open_reference_set(*sources, reference_folder)


def test_portraits_of_meshes_and_of_their_payloads_show_the_same_people(assets, tmp_path):
    drawn = open_gallery(mesh_sources(assets, [3], 2), tmp_path)
    people = coloured_people(assets, 3, 2)
    frames = rest_frames(people[0].betas)
    payload = colour(surface_field(people[1].mesh, frames), people[1].mesh)
    boxes = made_gallery([Primitives.place(frames, payload)])[0]
    alphas = [pictures[..., 3] > 128 for pictures in (drawn.pictures[1], boxes)]
    assert float((alphas[0] & alphas[1]).sum() / (alphas[0] | alphas[1]).sum()) > 0.9
    seen = alphas[0] & alphas[1]
    difference = (drawn.pictures[1].float() - boxes.float())[seen].abs().mean()
    assert float(difference) < 16
    assert drawn.attributes[1]["outfit"] == people[1].attributes["outfit"]


def test_copies_of_training_samples_are_distinguished_from_new_ones(reference):
    copies = compare(reference, reference.train_features)
    assert copies.nearest_ratio == pytest.approx(0, abs=1e-6)
    assert compare(reference, reference.held_features).nearest_ratio == pytest.approx(1)
    assert real_vs_real(reference, 8).nearest_ratio > 0.05


def test_people_far_from_all_real_ones_are_far_and_not_precise(reference):
    real = real_vs_real(reference, 8)
    strange = compare(reference, reference.held_features + 100 * reference.train_features.std())
    assert strange.frechet > 10 * real.frechet
    assert strange.kernel > real.kernel
    assert strange.precision == 0


@pytest.fixture
def _tiny_checkpoint(monkeypatch):
    monkeypatch.setattr(command, "load_checkpoint", lambda path, device: tiny_model())


@pytest.mark.usefixtures("_tiny_checkpoint")
def test_command_compares_generated_people_and_writes_figures(people, reference, reference_folder, tmp_path, capsys):
    out, judged = tmp_path / "figures.json", {"people": people, "reference": reference_folder, "holdout": 0.34}
    command.main(command.Options(**judged, count=5, steps=2, json=out))
    assert "| generated | 5 |" in capsys.readouterr().out
    figures = json.loads(out.read_text())
    assert set(figures["people"]) == {"generated", "trained on"}
    assert set(figures["people"]["generated"]) == set(COLUMNS)
    held = accuracies(reference.network, reference.held_features, reference.held.attributes)
    assert figures["feature_accuracy"] == held


def test_command_names_too_few_people_and_the_script_that_trains_a_missing_network(people, tmp_path):
    with refused(ValueError, "more than 3"):
        command.main(command.Options(people=people, reference=tmp_path / "judge", count=3))
    with refused(FileNotFoundError, "scripts/train_attribute_network.py"):
        command.main(command.Options(people=people, reference=tmp_path, holdout=0.34, count=5))
    assert not list(tmp_path.iterdir())
