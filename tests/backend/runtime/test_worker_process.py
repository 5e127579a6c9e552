"""A folder that one process holds."""

import subprocess
import sys
from pathlib import Path

from filelock import FileLock
from primdiffusion.files.regular_files import FileError
from primdiffusion.runtime.worker_process import LOCK, lock_folder
from support.errors import refused

HOLD = """
import sys
from pathlib import Path
from primdiffusion.runtime.worker_process import lock_folder
with lock_folder(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


def hold(folder: Path) -> subprocess.Popen[str]:
    """A process that holds the folder until its input ends."""
    pipe = subprocess.PIPE
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder)], stdin=pipe, stdout=pipe, stderr=pipe, text=True
    )
    assert process.stdout is not None
    process.first_line = process.stdout.readline().strip()  # type: ignore[attr-defined]
    return process


def test_of_two_processes_the_second_is_rejected_in_one_sentence(tmp_path):
    with hold(tmp_path / "run") as first:
        assert first.first_line == "held"
        with hold(tmp_path / "run") as second:
            assert second.first_line == ""
            sentence = second.stderr.read().splitlines()[-1]
        assert sentence.endswith(f"another process works in {tmp_path / 'run'}: wait for it, or give another folder")
        for _ in range(2):
            with refused(ValueError, "another process"), lock_folder(tmp_path / "run"):
                pass
        assert (tmp_path / "run" / LOCK).exists(), "a rejected process leaves the holder's lock"
        first.stdin.close()
    with lock_folder(tmp_path / "run"):
        pass


def test_a_killed_process_holds_nothing(tmp_path):
    with hold(tmp_path / "run") as killed:
        assert killed.first_line == "held"
        killed.kill()
    with lock_folder(tmp_path / "run"):
        (tmp_path / "run" / "a").touch()
    assert sorted(path.name for path in (tmp_path / "run").iterdir()) == sorted((LOCK, "a"))


def test_a_link_in_place_of_the_lock_is_named_and_its_target_stays(tmp_path):
    mine = tmp_path / "mine"
    mine.write_text("mine")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / LOCK).symlink_to(mine)
    with refused(FileError, LOCK), lock_folder(tmp_path / "run"):
        pass
    assert mine.read_text() == "mine"


def test_a_disk_without_locks_is_named(tmp_path, monkeypatch):
    def fails(*_: object, **__: object) -> None:
        raise NotImplementedError

    monkeypatch.setattr(FileLock, "_acquire", fails)
    with refused(ValueError, str(tmp_path / "run"), "locks"), lock_folder(tmp_path / "run"):
        pass
