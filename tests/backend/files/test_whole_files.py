"""All files or none, and nothing left of killed processes."""

import contextlib
import errno
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import pytest
from primdiffusion.files import whole_files
from primdiffusion.files.json_files import parse_json, parse_message, read_json
from primdiffusion.files.regular_files import FileError, is_plain_path
from primdiffusion.files.whole_files import (
    ABANDONED_AFTER_S,
    has_ended,
    is_abandoned,
    publish,
    remove_abandoned,
    remove_of_process,
    replacing,
    staged,
    staged_together,
    temporary_name,
    writer,
    written_whole,
)
from support.errors import refused
from two_writers import mixed

PATH = Path("x/figure.tar.gz")


def ended() -> int:
    """The id of a process that has ended."""
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()
    return child.pid


def half_done(writing) -> None:
    """Writes a file and then fails."""
    with writing as place:
        (place / "a" if place.is_dir() else place).write_text("half")
        raise RuntimeError


def contents(folder: Path) -> dict[str, str]:
    return {p.relative_to(folder).as_posix(): p.read_text() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_files_arrive_together_and_replace_older_ones(tmp_path):
    target = tmp_path / "new" / "folder"
    for text in ("one", "two"):
        with staged(target) as aside:
            (aside / "a").write_text(text)
            (aside / "b").write_text(text)
            if text == "two":
                assert (target / "a").read_text() == "one"
        assert contents(target) == {"a": text, "b": text}


def test_files_of_two_processes_that_publish_at_once_are_not_mixed(tmp_path):
    assert mixed(100, tmp_path) == 0


def test_a_folder_named_twice_is_not_waited_for(tmp_path):
    with staged_together([tmp_path, tmp_path]) as (one, two):
        (one / "a").write_text("a")
        (two / "b").write_text("b")
    assert contents(tmp_path) == {"a": "a", "b": "b"}


def test_no_file_is_written_through_a_link_out_of_the_folder(tmp_path):
    (tmp_path / "outside").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "textures").symlink_to(tmp_path / "outside")
    path = tmp_path / "out" / "textures" / "a.png"
    with refused(FileError, "a.png"), replacing(path, tmp_path / "out") as unfinished:
        unfinished.write_text("mine")
    assert not list((tmp_path / "outside").iterdir())


def test_an_error_leaves_an_old_folder_as_it_was_and_no_new_one(tmp_path):
    old = tmp_path / "old"
    old.mkdir()
    (old / "a").write_text("kept")
    for target in (old, tmp_path / "new" / "deep"):
        with pytest.raises(RuntimeError):
            half_done(staged(target))
    assert [path.name for path in tmp_path.iterdir()] == ["old"]
    assert contents(old) == {"a": "kept"}


def test_a_folder_in_place_of_one_file_keeps_all_others(tmp_path):
    (tmp_path / "two" / "b").mkdir(parents=True)
    (tmp_path / "two" / "a").write_text("kept")
    with contextlib.ExitStack() as files:
        for aside in files.enter_context(staged_together([tmp_path / "one", tmp_path / "two"])):
            for name in "abc":
                (aside / name).write_text("new")
        with pytest.raises(IsADirectoryError) as error:
            files.close()
    assert error.value.filename == str(tmp_path / "two" / "b")
    assert contents(tmp_path) == {"two/a": "kept"}
    assert not (tmp_path / "one").exists()


def test_a_move_that_fails_is_undone(tmp_path, monkeypatch):
    for name in ("made/a", "made/b/x", "made/c", "old/a", "old/b/y"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(name)
    before, replace = contents(tmp_path / "old"), os.replace

    def failing(source, target):
        if Path(source) == tmp_path / "made" / "c":
            raise OSError(errno.EIO, "Input/output error", str(target))
        replace(source, target)

    monkeypatch.setattr(os, "replace", failing)
    with refused(OSError, "Input/output"):
        publish([(tmp_path / "made", tmp_path / "old")])
    assert contents(tmp_path / "old") == before
    monkeypatch.undo()
    for name in ("made/a", "made/b/x"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(name)
    publish([(tmp_path / "made", tmp_path / "old")], last="a")
    assert contents(tmp_path / "old") == {"a": "made/a", "b/x": "made/b/x", "c": "made/c"}


def test_temporary_names_are_random_and_keep_the_ending():
    names = {temporary_name(PATH) for _ in range(100)}
    assert len(names) == 100
    assert all(name.parent == PATH.parent and name.suffix == ".gz" and name.name[0] == "." for name in names)


@pytest.mark.skipif(os.name == "nt", reason="Windows does not say whether a process has ended: age decides there")
@pytest.mark.unix
def test_what_an_ended_process_left_goes_but_not_what_a_living_one_writes(tmp_path):
    living, dead = temporary_name(tmp_path / "files"), temporary_name(tmp_path / "files")
    dead = dead.with_name(dead.name.replace(str(os.getpid()), str(ended())))
    for path in (living, dead):
        path.mkdir()
        (path / "half").touch()
    assert has_ended(dead.name)
    assert not has_ended(living.name)
    with staged(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == [living]


def test_elsewhere_only_age_tells_that_a_process_has_ended(tmp_path, monkeypatch):
    """The id of a process in another container may be that of a living one here, or of an ended one."""
    other = writer().replace(whole_files._space(), "0" * 8)
    young, old = (tmp_path / f".files.{other[:-1]}{end}.partial" for end in "ab")
    for path in (young, old):
        path.mkdir()
        (path / "half").touch()
    for path in (old / "half", old):
        os.utime(path, (0, os.stat(path).st_mtime - ABANDONED_AFTER_S - 1))
    assert (is_abandoned(young), is_abandoned(old)) == (False, True)
    assert not has_ended(old.name)
    remove_abandoned(tmp_path)
    assert list(tmp_path.iterdir()) == [young]


@pytest.mark.unix
def test_the_next_writing_of_a_file_removes_what_a_killed_one_left(tmp_path):
    code = (
        "import os, signal, sys\nfrom pathlib import Path\nfrom primdiffusion.files.whole_files import *\n"
        "with written_whole(Path(sys.argv[1])) as path:\n"
        "    path.write_text('half')\n    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    for name in ("picture.png", "other.png"):
        subprocess.run([sys.executable, "-c", code, str(tmp_path / name)], check=False)
    assert len(list(tmp_path.iterdir())) == 2
    with written_whole(tmp_path / "picture.png") as path:
        path.write_text("whole")
    left = [path.name for path in tmp_path.iterdir()]
    assert len(left) == 2
    assert "picture.png" in left
    assert any(name.startswith(".other.") for name in left)


def test_what_a_killed_child_left_is_known_by_its_id(tmp_path):
    mine = temporary_name(tmp_path / "files")
    mine.mkdir()
    (mine / "half").touch()
    remove_of_process(tmp_path, os.getpid() + 1)
    assert mine.exists()
    remove_of_process(tmp_path, os.getpid())
    assert not mine.exists()


@pytest.mark.parametrize("below", ["", "x", "x/y"])
def test_a_file_in_the_way_is_an_error_before_any_work(tmp_path, below):
    blocked = tmp_path / "file"
    blocked.write_text("content")
    began = False
    with refused(OSError, "file"), staged(blocked / below):
        began = True
    assert not began
    assert blocked.read_text() == "content"


def test_a_single_file_is_written_whole_or_not_at_all(tmp_path):
    path = tmp_path / "file"
    with written_whole(path) as unfinished:
        unfinished.write_text("one")
        assert not path.exists()
    with pytest.raises(RuntimeError):
        half_done(written_whole(path))
    assert path.read_text() == "one"
    assert list(tmp_path.iterdir()) == [path]


def test_a_temporary_file_needs_no_other(tmp_path):
    with written_whole(tmp_path / "a.png") as outer:
        with written_whole(outer) as inner:
            inner.write_text("x")
        assert (inner, list(tmp_path.iterdir())) == (outer, [outer])
    assert contents(tmp_path) == {"a.png": "x"}


def test_errors_name_the_file_that_was_asked_for(tmp_path):
    with pytest.raises(FileNotFoundError) as missing, written_whole(tmp_path / "no" / "a") as unfinished:
        unfinished.write_text("x")
    assert missing.value.filename == str(tmp_path / "no" / "a")
    with refused(OSError, "space") as full, written_whole(tmp_path / "a"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert full.value.filename == str(tmp_path / "a")
    with refused(PermissionError, "elsewhere"), written_whole(tmp_path / "a"):
        raise PermissionError(errno.EPERM, "not permitted", "elsewhere")
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no pipes in folders")
def test_folders_and_devices_are_not_replaced(tmp_path):
    """Who may do anything, as the administrator may, would otherwise lose a device to a picture."""
    os.mkfifo(tmp_path / "pipe")
    for place in (tmp_path, tmp_path / "pipe"):
        with refused(PermissionError, "regular"), written_whole(place):
            pass
    assert [entry.name for entry in tmp_path.iterdir()] == ["pipe"]


@pytest.mark.parametrize(
    "text",
    ["", "{", "[" * 100_000, "[" * 70 + "]" * 70, "NaN", "[1e999]", '{"a": -Infinity}', "[" + "1" * 400 + "]",
     "[" + "1" * 5000 + "]", "[" + "[]," * 600_000 + "1]", b"\xff", 3],
)  # fmt: skip
def test_what_no_reader_can_use_is_one_short_reason(text):
    with pytest.raises(ValueError) as raised:
        parse_json(text)
    assert len(str(raised.value)) < 150


def test_integers_beyond_64_bits_are_floats_so_that_nothing_overflows():
    assert parse_json("[9223372036854775807, 9223372036854775808]") == [2**63 - 1, 2.0**63]
    assert parse_message("[" + "9" * 400 + ", NaN]")[0] == math.inf


def test_ordinary_json_comes_back(tmp_path):
    tree = {"a": [1, -2.5, None, True, "ä"], "b": {"c": {}}}
    (tmp_path / "a.json").write_text(json.dumps(tree))
    assert read_json(tmp_path / "a.json") == tree


def test_a_file_without_an_end_is_not_read(tmp_path):
    os.mkfifo(tmp_path / "pipe.json")
    with pytest.raises(PermissionError):
        read_json(tmp_path / "pipe.json")
    with (tmp_path / "large.json").open("wb") as file:
        file.truncate(2**26)
    with refused(FileError, "32 MB"):
        read_json(tmp_path / "large.json")


@pytest.mark.parametrize(
    "path", [r"\\server\share\a.pkl", "//server/a", r"\\.\PhysicalDrive0", "a\0b", "", "x" * 5000, "smb://a/b"]
)
def test_paths_of_other_machines_and_devices_are_not_plain(path):
    assert not is_plain_path(path)
    assert is_plain_path("/home/anna/smpl.pkl")
    assert is_plain_path(r"C:\Users\anna\smpl.pkl")
