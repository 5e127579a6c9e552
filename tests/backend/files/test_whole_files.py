"""All files or none, and nothing left of killed processes."""

import contextlib
import errno
import json
import math
import os
from pathlib import Path

import pytest
from primdiffusion.files.json_files import parse_json, parse_message, read_json
from primdiffusion.files.regular_files import FileError, is_local_path
from primdiffusion.files.whole_files import (
    ABANDONED_AFTER_S,
    atomic_folder,
    atomic_path,
    atomic_replace,
    move_into_place,
    remove_abandoned,
    remove_of_process,
    temporary_name,
)
from support.errors import refused

PATH = Path("x/figure.tar.gz")


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
        with atomic_folder(target) as aside:
            (aside / "a").write_text(text)
            (aside / "b").write_text(text)
            if text == "two":
                assert (target / "a").read_text() == "one"
        assert contents(target) == {"a": text, "b": text}


def test_no_file_is_written_through_a_link_out_of_the_folder(tmp_path):
    (tmp_path / "outside").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "textures").symlink_to(tmp_path / "outside")
    path = tmp_path / "out" / "textures" / "a.png"
    with refused(FileError, "a.png"), atomic_replace(path, tmp_path / "out") as unfinished:
        unfinished.write_text("mine")
    assert not list((tmp_path / "outside").iterdir())


def test_an_error_leaves_an_old_folder_as_it_was_and_no_new_one(tmp_path):
    old = tmp_path / "old"
    old.mkdir()
    (old / "a").write_text("kept")
    for target in (old, tmp_path / "new" / "deep"):
        with pytest.raises(RuntimeError):
            half_done(atomic_folder(target))
    assert [path.name for path in tmp_path.iterdir()] == ["old"]
    assert contents(old) == {"a": "kept"}


def test_a_folder_in_place_of_one_file_keeps_all_others(tmp_path):
    (tmp_path / "b").mkdir(parents=True)
    (tmp_path / "a").write_text("kept")
    with contextlib.ExitStack() as files:
        aside = files.enter_context(atomic_folder(tmp_path))
        for name in "abc":
            (aside / name).write_text("new")
        with pytest.raises(IsADirectoryError) as error:
            files.close()
    assert error.value.filename == str(tmp_path / "b")
    assert contents(tmp_path) == {"a": "kept"}


def test_a_folder_replaces_a_folder(tmp_path):
    for name in ("made/a", "made/b/x", "made/c", "old/a", "old/b/y"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(name)
    move_into_place(tmp_path / "made", tmp_path / "old")
    assert contents(tmp_path / "old") == {"a": "made/a", "b/x": "made/b/x", "c": "made/c"}


def test_temporary_names_are_random_and_keep_the_ending():
    names = {temporary_name(PATH) for _ in range(100)}
    assert len(names) == 100
    assert all(name.parent == PATH.parent and name.suffix == ".gz" and name.name[0] == "." for name in names)


def test_what_is_a_day_old_goes_with_the_next_writing_but_not_what_may_be_written(tmp_path):
    young, old, other = (temporary_name(tmp_path / name) for name in ("files", "files", "other.png"))
    for path in (young, old):
        path.mkdir()
        (path / "half").touch()
    other.touch()
    for path in (old / "half", old, other):
        os.utime(path, (0, os.stat(path).st_mtime - ABANDONED_AFTER_S - 1))
    with atomic_path(tmp_path / "files") as path:
        path.touch()
    assert sorted(tmp_path.iterdir()) == sorted((young, other, tmp_path / "files"))
    remove_abandoned(tmp_path)
    assert sorted(tmp_path.iterdir()) == sorted((young, tmp_path / "files"))


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
    with refused(OSError, "file"), atomic_folder(blocked / below):
        began = True
    assert not began
    assert blocked.read_text() == "content"


def test_a_single_file_is_written_whole_or_not_at_all(tmp_path):
    path = tmp_path / "file"
    with atomic_path(path) as unfinished:
        unfinished.write_text("one")
        assert not path.exists()
    with pytest.raises(RuntimeError):
        half_done(atomic_path(path))
    assert path.read_text() == "one"
    assert list(tmp_path.iterdir()) == [path]


def test_a_temporary_file_needs_no_other(tmp_path):
    with atomic_path(tmp_path / "a.png") as outer:
        with atomic_path(outer) as inner:
            inner.write_text("x")
        assert (inner, list(tmp_path.iterdir())) == (outer, [outer])
    assert contents(tmp_path) == {"a.png": "x"}


def test_errors_name_the_file_that_was_asked_for(tmp_path):
    with pytest.raises(FileNotFoundError) as missing, atomic_path(tmp_path / "no" / "a") as unfinished:
        unfinished.write_text("x")
    assert missing.value.filename == str(tmp_path / "no" / "a")
    with refused(OSError, "space") as full, atomic_path(tmp_path / "a"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert full.value.filename == str(tmp_path / "a")
    with refused(PermissionError, "elsewhere"), atomic_path(tmp_path / "a"):
        raise PermissionError(errno.EPERM, "not permitted", "elsewhere")
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no pipes in folders")
def test_folders_and_devices_are_not_replaced(tmp_path):
    """Who may do anything, as the administrator may, would otherwise lose a device to a picture."""
    os.mkfifo(tmp_path / "pipe")
    for place in (tmp_path, tmp_path / "pipe"):
        with refused(PermissionError, "regular"), atomic_path(place):
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
def test_paths_of_other_machines_and_devices_are_not_local(path):
    assert not is_local_path(path)
    assert is_local_path("/home/anna/smpl.pkl")
