"""All files or none."""

import errno
import os

import pytest
from primdiffusion.staging import STAGING_PREFIX, staged, written_whole


def half_done(writing) -> None:
    """Writes a file and then fails."""
    with writing as place:
        (place / "a" if place.is_dir() else place).write_text("half")
        raise RuntimeError


def test_files_arrive_together_and_replace_older_ones(tmp_path):
    target = tmp_path / "new" / "folder"
    for text in ("one", "two"):
        with staged(target) as aside:
            (aside / "a").write_text(text)
            (aside / "b").write_text(text)
            if text == "two":
                assert (target / "a").read_text() == "one"
        assert sorted(path.name for path in target.iterdir()) == ["a", "b"]
        assert (target / "b").read_text() == text


def test_an_error_leaves_an_old_folder_as_it_was_and_no_new_one(tmp_path):
    old = tmp_path / "old"
    old.mkdir()
    (old / "a").write_text("kept")
    for target in (old, tmp_path / "new" / "deep"):
        with pytest.raises(RuntimeError):
            half_done(staged(target))
    assert [path.name for path in tmp_path.iterdir()] == ["old"]
    assert [path.name for path in old.iterdir()] == ["a"]
    assert (old / "a").read_text() == "kept"


def test_what_a_killed_process_left_is_cleared_but_not_what_a_living_one_writes(tmp_path):
    (tmp_path / f"{STAGING_PREFIX}99999999").mkdir()
    (tmp_path / f"{STAGING_PREFIX}99999999" / "half").touch()
    living = tmp_path / f"{STAGING_PREFIX}{os.getppid()}"
    living.mkdir()
    with staged(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == [living]


@pytest.mark.parametrize("below", ["", "x", "x/y"])
def test_a_file_in_the_way_is_an_error_before_any_work(tmp_path, below):
    blocked = tmp_path / "file"
    blocked.write_text("content")
    began = False
    with pytest.raises(OSError, match="file"), staged(blocked / below):
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


def test_errors_name_the_file_that_was_asked_for(tmp_path):
    with pytest.raises(FileNotFoundError) as missing, written_whole(tmp_path / "no" / "a") as unfinished:
        unfinished.write_text("x")
    assert missing.value.filename == str(tmp_path / "no" / "a")
    with pytest.raises(OSError, match="No space left") as full, written_whole(tmp_path / "a"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert full.value.filename == str(tmp_path / "a")
    with pytest.raises(PermissionError, match="elsewhere"), written_whole(tmp_path / "a"):
        raise PermissionError(errno.EPERM, "not permitted", "elsewhere")
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no pipes in folders")
def test_folders_and_devices_are_not_replaced(tmp_path):
    """Who may do anything, as the administrator may, would otherwise lose a device to a picture."""
    os.mkfifo(tmp_path / "pipe")
    for place in (tmp_path, tmp_path / "pipe"):
        with pytest.raises(PermissionError, match="not a regular file"), written_whole(place):
            pass
    assert [entry.name for entry in tmp_path.iterdir()] == ["pipe"]
