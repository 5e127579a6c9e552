"""`windows_rules` at work: run by tests/contract/test_windows_rules.py, with the plugin."""

import mmap
import os
import signal
import subprocess
import sys

import pytest
from primdiffusion.files import whole_files

import blender_primdiffusion.backend.client as client_module


def test_an_open_file_is_not_removed_moved_or_replaced_nor_is_its_folder_moved(tmp_path):
    path, other = tmp_path / "open", tmp_path / "other"
    path.write_bytes(b"x")
    other.write_bytes(b"y")
    with path.open("rb"):
        for attempt in (
            path.unlink,
            lambda: os.rename(path, tmp_path / "new"),
            lambda: os.replace(other, path),
            lambda: tmp_path.rename(tmp_path.with_name("moved")),
        ):
            with pytest.raises(PermissionError):
                attempt()
    path.unlink()


def test_a_mapped_file_is_not_removed(tmp_path):
    path = tmp_path / "mapped"
    path.write_bytes(b"x" * 5000)
    with path.open("rb") as file:
        mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    with pytest.raises(PermissionError):
        path.unlink()
    mapped.close()
    path.unlink()


def test_a_file_that_a_child_has_open_is_not_removed(tmp_path):
    path = tmp_path / "open"
    path.write_bytes(b"x")
    with path.open("rb") as file:
        child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE, stdout=file)
    with pytest.raises(PermissionError):
        path.unlink()
    child.communicate(b"\n")
    path.unlink()


def test_a_moved_file_takes_no_name_that_is_taken(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).write_bytes(b"x")
    with pytest.raises(FileExistsError):
        os.rename(tmp_path / "a", tmp_path / "b")
    (tmp_path / "folder").mkdir()
    (tmp_path / "new").mkdir()
    with pytest.raises(PermissionError):
        os.replace(tmp_path / "new", tmp_path / "folder")


def test_text_gets_line_ends_unless_it_is_written_by_us(tmp_path):
    (tmp_path / "a").write_text("x\n", encoding="utf-8")
    assert (tmp_path / "a").read_bytes() == b"x\r\n"
    whole_files.write_atomically(tmp_path / "b", "x\n")
    assert (tmp_path / "b").read_bytes() == b"x\n"


def test_our_modules_see_the_modules_of_windows():
    assert whole_files.os.name == "nt"
    assert not hasattr(whole_files.os, "fork")
    assert os.name == "posix"
    with pytest.raises(ModuleNotFoundError):
        exec("import termios", vars(whole_files))
    imported = {"__builtins__": vars(whole_files)["__builtins__"]}
    exec("import signal", imported)
    assert imported["signal"].SIGINT == signal.SIGINT
    assert not hasattr(imported["signal"], "SIGKILL")


def test_text_without_an_encoding_is_an_error_in_our_modules(tmp_path):
    (tmp_path / "a").write_bytes(b"x")
    read = {"__builtins__": vars(whole_files)["__builtins__"], "__name__": "primdiffusion.files.whole_files"}
    for line in ("open(path)", "Path(path).read_text()"):
        with pytest.raises(EncodingWarning):
            exec(f"from pathlib import Path\n{line}", {**read, "path": str(tmp_path / "a")})


def test_a_process_with_a_console_is_an_error_in_the_extension():
    with pytest.raises(AssertionError):
        client_module.subprocess.Popen([sys.executable, "-c", ""])
    with pytest.raises(ValueError, match="preexec_fn"):
        whole_files.__builtins__["__import__"]("subprocess").run([sys.executable], preexec_fn=print)
