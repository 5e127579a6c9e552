"""Models as folders of the hub's layout."""

import dataclasses
import json

import pytest
import torch
from primdiffusion.diffusion.checkpoint import load_checkpoint, read_card
from primdiffusion.diffusion.model import sample
from primdiffusion.diffusion.model_card import model_card
from primdiffusion.diffusion.pretrained import save_pretrained
from primdiffusion.diffusion.schedule import linear
from primdiffusion.files.regular_files import FileError
from support.errors import refused
from tiny_model import save_tiny_checkpoint, tiny_model

COMMIT = "0123456789abcdef0123456789abcdef01234567"


def drawn(model):
    *_, last = sample(model, [3], steps=2)
    return last.x0


def hub(folder, *commits, main=None):
    """A repository of a hub cache: snapshots are links to blobs."""
    blob = save_tiny_checkpoint(folder / "blobs" / "weights")
    for commit in commits:
        (folder / "snapshots" / commit).mkdir(parents=True)
        (folder / "snapshots" / commit / "model.safetensors").symlink_to(blob)
    if main is not None:
        (folder / "refs").mkdir()
        (folder / "refs" / "main").write_text(main)
    return folder


def test_a_saved_folder_loads_as_the_same_model(tmp_path):
    loaded = load_checkpoint(save_tiny_checkpoint(tmp_path / "tiny.safetensors"))
    folder = save_pretrained(loaded, tmp_path / "folder")
    assert sorted(path.name for path in folder.iterdir()) == ["README.md", "config.json", "model.safetensors"]
    again = load_checkpoint(folder)
    assert torch.equal(drawn(again), drawn(loaded))
    assert again.vocabulary == loaded.vocabulary
    config = json.loads((folder / "config.json").read_text())
    assert (config["library_name"], config["kind"], config["schedule"]) == ("primdiffusion", "person", "linear")
    card = (folder / "README.md").read_text()
    assert card.startswith("---\nlibrary_name: primdiffusion\nlicense: other\n")
    assert "# Model card: tiny" in card


def test_the_readme_is_the_card_of_the_default_checkpoint(tmp_path):
    folder = save_pretrained(load_checkpoint(), tmp_path / "default")
    card = (folder / "README.md").read_text()
    assert "license: cc0-1.0" in card
    assert card.split("---\n", 2)[2].split("sha256")[0] == model_card(read_card()).split("sha256")[0]


@pytest.mark.parametrize(("commits", "main"), [((COMMIT, "other"), COMMIT + "\n"), ((COMMIT,), None)])
def test_a_repository_of_a_hub_cache_loads_its_main_or_only_snapshot(tmp_path, commits, main):
    model = load_checkpoint(hub(tmp_path / "models--us--tiny", *commits, main=main))
    assert model.card["name"] == "tiny"
    assert load_checkpoint(tmp_path / "models--us--tiny" / "snapshots" / COMMIT).card == model.card


@pytest.mark.parametrize(("commits", "main"), [(("a", "b"), None), ((), None), (("a",), "../snapshots/a")])
def test_a_folder_without_one_model_is_refused(tmp_path, commits, main):
    with refused(FileError):
        load_checkpoint(hub(tmp_path / "models--us--tiny", *commits, main=main))


def test_a_name_on_the_hub_is_not_downloaded():
    with refused(FileNotFoundError, "download"):
        load_checkpoint("owner/name")


def test_models_that_a_folder_cannot_hold_are_refused_and_leave_nothing(tmp_path):
    levels = dataclasses.replace(linear(), alpha_bar=linear().alpha_bar * 0.9)
    unnamed = dataclasses.replace(tiny_model(), schedule=levels)
    imported = dataclasses.replace(tiny_model(), body_setup=object())
    for model, word in ((unnamed, "no name"), (imported, "your body file")):
        with pytest.raises(ValueError, match=word):
            save_pretrained(model, tmp_path / "folder")
    assert not (tmp_path / "folder").exists()
