"""Works that outlive Blender: a process that is killed with works in line, and another that resumes them."""

from __future__ import annotations

import json
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import bpy
import pytest
from jobs_driven import drive, shown

from blender_primdiffusion.scene.human import humans
from blender_primdiffusion.ui.generate.work import GenerateWork
from blender_primdiffusion.ui.jobs import kept as kept_module
from blender_primdiffusion.ui.jobs.follow import look_for_left
from blender_primdiffusion.ui.jobs.panel import PRIMDIFFUSION_PT_jobs, PRIMDIFFUSION_PT_jobs_left
from blender_primdiffusion.ui.jobs.queue import queue
from blender_primdiffusion.worker.kept_works import KeptWork, Shelf

ROOT = Path(__file__).parents[2]
ops = bpy.ops.primdiffusion
PROGRAM = """
    import sys, time
    sys.path.insert(0, sys.argv[1])
    import bpy
    from pathlib import Path
    import blender_primdiffusion
    from blender_primdiffusion.ui.jobs import kept
    kept.own_folder = lambda: Path(sys.argv[2])
    blender_primdiffusion.register()
    bpy.ops.wm.save_as_mainfile(filepath=sys.argv[3])
    from blender_primdiffusion.ui.generate.work import GenerateWork
    from blender_primdiffusion.ui.jobs.queue import queue
    for seed in (21, 22):
        queue.add(bpy.context, GenerateWork(seed, 1, checkpoint=""))
    print("in line", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def folder(addon, tmp_path, monkeypatch) -> Path:
    """The extension's own, where the works lie in `queue`."""
    queue.kept.close()
    monkeypatch.setattr(kept_module, "own_folder", lambda: tmp_path / "own")
    return tmp_path / "own"


def kept(seed: int, kind: str = "generate", scene: str = "Scene", blend: str | None = None) -> KeptWork:
    """For the file that is open, unless another is given."""
    work = {"seed": seed, "steps": 1, "checkpoint": ""}
    return KeptWork(kind, f"Human, seed {seed}", work, scene, bpy.data.filepath if blend is None else blend)


def leave(folder: Path, *works: KeptWork) -> None:
    """As a process that has died."""
    shelf = Shelf(folder / "queue")
    shelf.keep(works)
    shelf.close()


def test_works_in_line_of_a_killed_blender_are_offered_to_the_next_and_resumed(folder, tmp_path):
    blend = str(tmp_path / "fïlm 1.blend")
    command = [sys.executable, "-c", textwrap.dedent(PROGRAM), str(ROOT), str(folder), blend]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as other:
        while (line := other.stdout.readline()).strip() != "in line":
            assert line, "the other Blender ended"
        look_for_left()
        assert not queue.kept.left, "those of a living Blender are its own"
        other.kill()
    look_for_left()
    assert PRIMDIFFUSION_PT_jobs_left.poll(bpy.context)
    texts = shown(PRIMDIFFUSION_PT_jobs_left, bpy.context)
    assert texts == [
        "For fïlm 1.blend, Scene", "Human, seed 21", "Human, seed 22", "wm.open_mainfile",
        "primdiffusion.resume_works", "primdiffusion.discard_works",
    ]  # fmt: skip
    assert not queue.busy, "nothing runs by itself"
    with pytest.raises(RuntimeError, match=r"nothing was left for this file, but for fïlm 1\.blend, Scene: open it"):
        ops.resume_works()
    bpy.ops.wm.open_mainfile(filepath=blend)
    assert "wm.open_mainfile" not in shown(PRIMDIFFUSION_PT_jobs_left, bpy.context)
    assert ops.resume_works() == {"FINISHED"}
    drive()
    assert len(humans(bpy.context.scene)) == 2
    look_for_left()
    assert not queue.kept.left
    assert not list((folder / "queue").iterdir())


def test_unregistering_with_works_in_line_leaves_them_to_the_next_start(folder):
    queue.add(bpy.context, GenerateWork(7, 1))
    queue.close()
    look_for_left()
    assert [work.label for work in queue.kept.left] == ["Human, seed 7"]
    assert ops.discard_works() == {"FINISHED"}
    look_for_left()
    assert not queue.kept.left


def test_what_is_done_cancelled_or_awaited_by_a_script_is_not_kept(folder):
    ops.generate(seed=7, steps=1)
    assert not list((folder).glob("queue/*.json"))
    number = queue.add(bpy.context, GenerateWork(7, 1)).number
    (file,) = folder.glob("queue/*.json")
    assert json.loads(file.read_text())["works"][0]["work"]["seed"] == 7
    ops.cancel(number=number)
    assert not file.exists()
    queue.add(bpy.context, GenerateWork(8, 1))
    drive()
    assert not list(folder.glob("queue/*.json"))


def test_works_enter_the_scenes_that_they_were_asked_for(folder):
    first, second = bpy.context.scene, bpy.data.scenes.new("Second")
    leave(folder, kept(31, scene="Second"), kept(32), kept(33, scene="Third"), kept(34, blend="/films/Kürbis 1.blend"))
    look_for_left()
    assert ops.resume_works() == {"FINISHED"}
    assert (len(humans(first)), len(humans(second))) == (1, 1)
    assert [work.work["seed"] for work in queue.kept.left] == [33, 34]
    texts = shown(PRIMDIFFUSION_PT_jobs_left, bpy.context)
    assert "For shot.blend, Third (not there any more)" in texts
    assert "For Kürbis 1.blend, Scene" in texts
    assert "wm.open_mainfile" not in texts, "there is no such file"


def test_works_of_another_file_enter_this_one_only_when_that_is_said(folder):
    leave(folder, kept(31, blend="/films/Kürbis 1.blend"), kept(32, blend="/films/Kürbis 2.blend"), kept(33, blend=""))
    look_for_left()
    with pytest.raises(RuntimeError, match="nothing was left for this file"):
        ops.resume_works()
    assert len(queue.kept.left) == 3
    assert ops.resume_works(blend="/films/Kürbis 2.blend") == {"FINISHED"}
    assert len(humans(bpy.context.scene)) == 1
    assert ops.resume_works(blend="", scene="Scene") == {"FINISHED"}
    assert len(humans(bpy.context.scene)) == 2
    assert ops.discard_works(blend="/films/Kürbis 2.blend") == {"FINISHED"}
    assert [work.work["seed"] for work in queue.kept.left] == [31]
    assert ops.discard_works() == {"FINISHED"}
    assert not queue.kept.left


def test_a_file_saved_under_another_name_takes_its_works_along(folder, tmp_path):
    queue.add(bpy.context, GenerateWork(7, 1))
    bpy.context.scene.name = "Küche"
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "take 2.blend"))
    queue.close()
    look_for_left()
    (left,) = queue.kept.left
    assert (Path(left.blend).name, left.scene) == ("take 2.blend", "Küche")
    assert ops.resume_works() == {"FINISHED"}
    assert len(humans(bpy.context.scene)) == 1


def test_what_is_not_resumed_stays_for_the_next_blender(folder):
    leave(folder, kept(31), kept(32, blend="/films/Kürbis 1.blend"))
    look_for_left()
    ops.resume_works()
    queue.close()
    look_for_left()
    assert [work.work["seed"] for work in queue.kept.left] == [32]


def test_what_is_not_discarded_stays_for_the_next_blender(folder):
    leave(folder, kept(31), kept(32, blend="/films/Kürbis 1.blend"))
    look_for_left()
    ops.discard_works(blend="/films/Kürbis 1.blend")
    queue.close()
    look_for_left()
    assert [work.work["seed"] for work in queue.kept.left] == [31]


def test_what_this_version_does_not_know_is_told_and_the_rest_is_resumed(folder):
    leave(folder, kept(31), kept(32, kind="sculpt"))
    look_for_left()
    assert ops.resume_works() == {"FINISHED"}
    assert len(humans(bpy.context.scene)) == 1
    leave(folder, kept(32, kind="sculpt"))
    look_for_left()
    with pytest.raises(RuntimeError, match="knows no work 'sculpt'"):
        ops.resume_works()


@pytest.mark.parametrize("text", ["", "{", '{"version": 2, "works": []}', '{"version": 1, "works": [{"a": 1}]}', "[]"])
def test_a_damaged_file_offers_nothing(tmp_path, text):
    (tmp_path / "1-1.json").write_text(text)
    shelf = Shelf(tmp_path)
    assert shelf.left() == []
    assert shelf.claim() == []
    assert not list(tmp_path.iterdir())


def test_only_one_of_two_blenders_gets_what_was_left(tmp_path):
    leave(tmp_path, kept(1))
    time.sleep(0.001)
    one, two = Shelf(tmp_path / "queue"), Shelf(tmp_path / "queue")
    assert len(one.left()) == len(two.left()) == 1
    assert (len(one.claim()), len(two.claim())) == (1, 0)


def test_the_works_of_those_who_died_first_come_first(tmp_path):
    for seed in (5, 6, 7):
        leave(tmp_path, kept(seed))
    assert [work.work["seed"] for work in Shelf(tmp_path / "queue").left()] == [5, 6, 7]


def test_a_folder_that_cannot_be_written_is_told_and_work_goes_on(folder):
    folder.write_text("a file where the folder should be")
    queue.add(bpy.context, GenerateWork(7, 1))
    assert "would not survive" in " ".join(shown(PRIMDIFFUSION_PT_jobs, bpy.context))
    drive()
    assert len(humans(bpy.context.scene)) == 1
