"""Human from Captures as the user meets it, with the real client and a child that can be told to misbehave."""

import json
from pathlib import Path
from types import SimpleNamespace

import bpy
import pytest
from human_files import person_file
from jobs_driven import drive, error_of, notice_of, shown, until_running
from support.errors import refused
from support.fake_child import request_of

from blender_primdiffusion.jobs import generate
from blender_primdiffusion.jobs.queue import queue
from blender_primdiffusion.scene.human import humans, parts_of, session_folder
from blender_primdiffusion.ui import reconstruct_panel
from blender_primdiffusion.ui.generate_panel import PRIMDIFFUSION_PT_generate
from blender_primdiffusion.ui.reconstruct_panel import PRIMDIFFUSION_PT_human_from_captures

pytestmark = pytest.mark.any_blender


@pytest.fixture
def captures(tmp_path) -> Path:
    (tmp_path / "captures").mkdir()
    return tmp_path / "captures"


def asked_of_the_child(person: bpy.types.Object) -> dict:
    return request_of(person_file(person))


def test_the_operator_builds_a_human_from_the_chosen_captures(addon, captures):
    panel = addon.scene.primdiffusion_reconstruct
    panel.capture, panel.subject, panel.frame, panel.views, panel.by = f"{captures}/", "anna", 2, 5, "prior"
    assert bpy.ops.primdiffusion.human_from_captures() == {"FINISHED"}
    (person,) = humans(addon.scene)
    sent = asked_of_the_child(person)
    assert Path(sent.pop("capture")) == captures
    assert Path(sent.pop("out_dir")).name.startswith("reconstruct_")
    assert sent == {"subject": "anna", "frame": 2, "views": 5, "by": "prior"}
    assert not list(Path(bpy.app.tempdir).glob("reconstruct_*"))
    assert notice_of("reconstruct").startswith("Reconstructed in ")


def test_a_folder_beside_the_blend_is_found(addon, captures):
    panel = addon.scene.primdiffusion_reconstruct
    panel.capture, panel.subject, panel.frame, panel.views, panel.by = "//captures", "berta", 3, 4, "prior"
    assert bpy.ops.primdiffusion.human_from_captures() == {"FINISHED"}
    sent = asked_of_the_child(humans(addon.scene)[0])
    assert Path(sent["capture"]) == captures
    assert (sent["subject"], sent["frame"], sent["views"], sent["by"]) == ("berta", 3, 4, "prior")


def reconstruct(folder: Path) -> set[str]:
    bpy.context.scene.primdiffusion_reconstruct.capture = str(folder)
    return bpy.ops.primdiffusion.human_from_captures()


def test_without_a_folder_the_operator_says_so(addon):
    with refused(RuntimeError, "captures"):
        bpy.ops.primdiffusion.human_from_captures()


@pytest.mark.parametrize(("order", "sentence"), [("dies", "ended by itself"), ("fails", "checkpoint is damaged")])
def test_a_failure_raises_one_sentence_and_leaves_nothing(addon, captures, tmp_path, monkeypatch, order, sentence):
    monkeypatch.setenv("FAKE_ORDER", order)
    with pytest.raises(RuntimeError, match=sentence) as caught:
        reconstruct(captures)
    assert str(caught.value).count("Error:") == 1
    assert not bpy.data.objects
    assert not session_folder().exists()
    assert not list(Path(bpy.app.tempdir).glob("reconstruct_*"))
    assert sentence in " ".join(shown(PRIMDIFFUSION_PT_human_from_captures, addon))
    assert sentence not in " ".join(shown(PRIMDIFFUSION_PT_generate, addon))


def test_a_warning_of_the_backend_is_shown(addon, captures):
    addon.scene.primdiffusion_reconstruct.views = 1
    reconstruct(captures)
    assert len(humans(addon.scene)) == 1
    assert "Only one view." in " ".join(shown(PRIMDIFFUSION_PT_human_from_captures, addon))


def test_the_panel_shows_progress_and_cancel_ends_the_job_without_a_person(addon, captures, monkeypatch):
    monkeypatch.setenv("FAKE_ORDER", "takes long")
    assert "primdiffusion.human_from_captures" in shown(PRIMDIFFUSION_PT_human_from_captures, addon)
    queue.add(addon, generate.ReconstructJob(str(captures), "", 0, 8))
    until_running()
    texts = shown(PRIMDIFFUSION_PT_human_from_captures, addon)
    assert texts == ["primdiffusion.human_from_captures", "Reconstructing", "primdiffusion.cancel"]
    bpy.ops.primdiffusion.cancel()
    drive()
    assert (error_of("reconstruct"), notice_of("reconstruct")) == ("", "Cancelled")
    assert not humans(addon.scene)


def test_subjects_are_those_of_the_list_or_of_the_folders(captures):
    for name in ("berta", "anna"):
        (captures / name).mkdir()
        (captures / name / "cameras.json").write_text("{}")
    assert reconstruct_panel.subjects_in(captures) == ["anna", "berta"]
    assert reconstruct_panel.subjects_in(captures / "anna") == []
    (captures / "release_human_list.txt").write_text("clara\n\nanna\n")
    assert reconstruct_panel.subjects_in(captures) == ["anna", "clara"]
    assert reconstruct_panel.subjects_in(captures / "nowhere") == []


def test_the_search_offers_subjects_that_hold_what_was_typed(captures):
    (captures / "release_human_list.txt").write_text("clara\nanna\nHANNA\n")
    asked = SimpleNamespace(capture=str(captures))
    assert list(reconstruct_panel._search(asked, None, "ann")) == ["HANNA", "anna"]
    assert list(reconstruct_panel._search(SimpleNamespace(capture=""), None, "")) == []


@pytest.mark.slow
def test_the_real_child_makes_a_person_of_real_captures(real_child, tmp_path, monkeypatch):
    from capture_scenes import captured
    from tiny_encoder import save_tiny_encoder

    encoder = save_tiny_encoder(tmp_path / "encoder.safetensors")
    folder = captured(tmp_path / "made", people=2, frames=1, passes=("img", "mask"))
    monkeypatch.setattr(
        "blender_primdiffusion.jobs.queue.preference", lambda name: str(encoder) if name == "encoder" else ""
    )
    with refused(RuntimeError, "person_000000"):
        reconstruct(folder)
    panel = real_child.scene.primdiffusion_reconstruct
    panel.capture, panel.subject, panel.views = str(folder), "person_000001", 3
    assert bpy.ops.primdiffusion.human_from_captures() == {"FINISHED"}
    (person,) = humans(real_child.scene)
    about = json.loads(person["primdiffusion_human"])
    assert (about["reconstructed_from"], about["checkpoint"]) == ("person_000001", "tiny encoder")
    assert len(about["views"]) == 3
    assert len(parts_of(person)) == 4
