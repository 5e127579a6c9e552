"""Set up the Python environments, then run the demo, the tests or the checks, on Linux, macOS and Windows alike.

    python -m scripts.setup demo
    python -m scripts.setup test -x -k motion        # what follows the target goes to pytest
    python -m scripts.setup help

`make demo`, `make test` and so on call it. It needs Python 3.11 and nothing else; each environment is a folder in the
checkout (.venv, .venv52, .venv53), and nothing else on the machine is touched. Environment variables: PYTHON313,
TEST_ARGS (see `help`).
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NoReturn

ROOT = Path(__file__).resolve().parents[1]
WINDOWS = os.name == "nt"
BY_MAKE = "MAKELEVEL" in os.environ
TEST_ARGS = shlex.split(os.environ.get("TEST_ARGS", ""))
VENV, VENV52, VENV53 = ROOT / ".venv", ROOT / ".venv52", ROOT / ".venv53"
"""One environment for each Blender, which is a Python module: 5.0, 5.2 and 5.3."""
MEGABYTES = {VENV: 3700, VENV52: 1300, VENV53: 1300}
"""Installed sizes with torch's CPU build, MB (`du -sm`): missing disk space is reported before pip begins."""
PIP_MB = 1500
"""Space that pip needs in its temporary folder, MB."""
ONE_THREAD = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"}
ON_EVERY_BLENDER = ["tests/blender", "--confcutdir", "tests/blender", "-m", "not slow and not gpu and not any_blender"]


class Stop(Exception):
    """What went wrong and what to do, in a sentence."""


# the targets: a function's docstring is its line of help


def demo(_: Sequence[str]) -> None:
    """generate a human in Blender, walk it, render it: see demo_out/"""
    ready()
    run([program(VENV), "benchmarks/demo.py", "--out", "demo_out"])


def help_(_: Sequence[str]) -> None:
    """this list"""
    command = "make" if BY_MAKE else "python -m scripts.setup"
    for name, function in TARGETS.items():
        print(f"{command} {name:<11}{function.__doc__}")


def test(arguments: Sequence[str]) -> None:
    '''the tests on Blender 5.0, 5.2 and 5.3; options for pytest: TEST_ARGS="-x -k motion"'''
    has_313 = python313() is not None
    check_room([VENV, *([VENV52, VENV53] if has_313 else [])])
    versions = {"5.0": test_50, "5.2": test_52, "5.3": test_53}
    failures = {version: _failure(test_one, arguments) for version, test_one in versions.items()}
    for version, failure in failures.items():
        passed = "passed" if version == "5.0" or has_313 else "not tested, without a Python 3.13"
        print(f"Blender {version}: {failure or passed}", flush=True)
    if any(failures.values()):
        sys.exit(1)


def _failure(test_one: Callable[[Sequence[str]], None], arguments: Sequence[str]) -> str:
    """What went wrong in a target; empty if nothing did."""
    try:
        test_one(arguments)
    except Stop as stop:
        return f"FAILED: {stop}"
    except SystemExit as end:
        return f"FAILED (exit code {end.code})"
    return ""


def test_50(arguments: Sequence[str]) -> None:
    """all tests but the slow ones, on Blender 5.0"""
    ready_to_test()
    run_pytest(VENV, arguments)


def test_52(arguments: Sequence[str]) -> None:
    """the tests that depend on Blender's version, on 5.2; PYTHON313=/path/to/python3.13 names its Python"""
    _test_on_313("5.2", VENV52, arguments)


def test_53(arguments: Sequence[str]) -> None:
    """the same on Blender 5.3"""
    _test_on_313("5.3", VENV53, arguments)


def _test_on_313(version: str, folder: Path, arguments: Sequence[str]) -> None:
    python = python313()
    if python is None:
        name = "/path/to/python3.13"
        way = f"make test PYTHON313={name}" if BY_MAKE else f"set the environment variable PYTHON313 to {name}"
        print(f"Blender {version} was not tested: its module needs Python 3.13. Install it, or name it: {way}")
        return
    ready_to_test()  # the other has no torch: the backend's process runs in .venv
    ready_313(folder, python)
    run_pytest(folder, [*ON_EVERY_BLENDER, *arguments], PRIMDIFFUSION_PYTHON=program(VENV))


def test_all(arguments: Sequence[str]) -> None:
    """all tests, with the slow ones, on Blender 5.0"""
    ready_to_test()
    run([program(VENV), "-m", "pytest", "-m", "not gpu", *TEST_ARGS, *arguments])


def lint(_: Sequence[str]) -> None:
    """ruff, import contracts, types"""
    ready_to_test()
    run([program(VENV, "ruff"), "check", "."])
    run([program(VENV, "ruff"), "format", "--check", "."])
    run([program(VENV, "lint-imports")])
    run([program(VENV, "pyright")])


def types(_: Sequence[str]) -> None:
    """types as on Linux, Windows and macOS, whichever this is"""
    ready_to_test()
    for system in ("Linux", "Windows", "Darwin"):
        run([program(VENV, "pyright"), "--pythonplatform", system])


def setup(_: Sequence[str]) -> None:
    """the environment .venv, with what tests and lint need"""
    ready_to_test()


def clean(_: Sequence[str]) -> None:
    """remove demo_out, build and dist"""
    for name in ("demo_out", "build", "dist"):
        shutil.rmtree(ROOT / name, ignore_errors=True)


TARGETS: dict[str, Callable[[Sequence[str]], None]] = {
    "demo": demo,
    "help": help_,
    "test": test,
    "test-5.0": test_50,
    "test-5.2": test_52,
    "test-5.3": test_53,
    "test-all": test_all,
    "lint": lint,
    "types": types,
    "setup": setup,
    "clean": clean,
}


# the environments: each has a file that is newer than what it was made from when it is finished


def ready() -> None:
    """Set up .venv with Blender's module, torch and the other packages of the demo."""
    mark = VENV / "ready"
    if is_newer(mark, ROOT / "pyproject.toml", ROOT / "requirements.lock"):
        return
    python = python311()
    check_room([VENV])
    if not Path(program(VENV)).exists():
        run([python, "-m", "venv", str(VENV)])
    print(f"Installing Blender's Python module, torch and other packages into {VENV}: this takes some minutes")
    pip_install(".[training,blender]")
    if subprocess.run([program(VENV), "-c", "import bpy"], cwd=ROOT, env=environment(), check=False).returncode:
        raise Stop("Blender's module did not load: install the system packages named in README.md")
    print("Generating a small human, which compiles the renderer, once")
    with tempfile.TemporaryDirectory(dir=temporary_folder()) as folder:
        run([program(VENV), "-m", "primdiffusion", "generate", "--steps", "3", "--size", "16", "--out", folder])
    mark.touch()


def ready_to_test() -> None:
    """Add to .venv what tests and lint need."""
    ready()
    mark = VENV / "ready-to-test"
    if not is_newer(mark, VENV / "ready"):
        pip_install(".[training,blender,test]")
        mark.touch()


def ready_313(folder: Path, python: str) -> None:
    """Set up .venv52 or .venv53 with the module of that Blender, by the lock of the same number."""
    mark, lock = folder / "ready", f"requirements{folder.name.removeprefix('.venv')}.lock"
    if is_newer(mark, ROOT / lock):
        return
    check_room([folder])
    if not Path(program(folder)).exists():
        run([python, "-m", "venv", str(folder)])
    run([program(folder), "-m", "pip", "install", *PIP_OPTIONS, "--no-deps", "-r", lock])
    mark.touch()


PIP_OPTIONS = ["--disable-pip-version-check"]


def pip_install(requirement: str) -> None:
    """Install this checkout into .venv, in the versions of the lock."""
    run([program(VENV), "-m", "pip", "install", *PIP_OPTIONS, "-c", "requirements.lock", "-e", requirement])


def program(folder: Path, name: str = "python") -> str:
    """The path of a program in an environment."""
    return str(folder / "Scripts" / f"{name}.exe" if WINDOWS else folder / "bin" / name)


def is_newer(mark: Path, *sources: Path) -> bool:
    """Whether `mark` is there and none of its sources has changed since."""
    return mark.exists() and all(mark.stat().st_mtime >= source.stat().st_mtime for source in sources)


# interpreters


def python311() -> str:
    """A Python 3.11: the one that runs this, else, unless PYTHON chose that, the first that is found. Raises Stop."""
    if sys.version_info[:2] == (3, 11):
        return sys.executable
    found = None if "PYTHON" in os.environ else next(interpreters("3.11"), None)
    if found is None:
        way = "make PYTHON=/path/to/python3.11" if BY_MAKE else "/path/to/python3.11 -m scripts.setup"
        raise Stop(f"{sys.executable} is not Python 3.11, which bpy 5.0 needs: install it, or run {way}")
    return found


def python313() -> str | None:
    """The Python 3.13 that PYTHON313 names, else the first that is found; None without one."""
    named = os.environ.get("PYTHON313")
    return next(interpreters("3.13"), None) if named is None else named or None


def interpreters(version: str) -> Iterable[str]:
    """Interpreters of a version that can make environments: on the PATH, by Windows' launcher, of pyenv."""
    pyenv = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv") / "versions"
    named = [[f"python{version}"], *([str(path)] for path in sorted(pyenv.glob(f"{version}*/bin/python{version}")))]
    if WINDOWS:
        named.append(["py", f"-{version}"])
    look = "import sys, ensurepip; print('%d.%d' % sys.version_info[:2], sys.executable)"
    for command in named:
        found, _, path = answer_of([*command, "-c", look]).partition(" ")
        if found == version:
            yield path


# disk space


def check_room(folders: Iterable[Path]) -> None:
    """Raise Stop, before pip begins, where the disk cannot hold the environments that are still to be installed."""
    need = sum(missing_mb(folder) for folder in folders)
    if need <= 0:
        return
    temporary = temporary_folder()
    if ROOT.stat().st_dev == temporary.stat().st_dev:
        _check_free(ROOT, need + PIP_MB, "the Python environments and what pip downloads", "free some space")
        return
    _check_free(ROOT, need, "the Python environments", "free some space")
    variable = "TEMP" if WINDOWS else "TMPDIR"
    _check_free(temporary, PIP_MB, "what pip downloads", f"free some space, or name another folder with {variable}")


def missing_mb(folder: Path) -> int:
    """How much of an environment is still to be installed, MB."""
    if (folder / "ready").exists():
        return 0
    sizes = (Path(inner, name).lstat() for inner, _, names in os.walk(folder) for name in names)
    there = sum(getattr(size, "st_blocks", size.st_size / 512) * 512 for size in sizes)
    return max(0, MEGABYTES[folder] - int(there / 2**20))


def temporary_folder() -> Path:
    """pip's temporary folder; Python's own function fails on a full disk, since it tries to write."""
    named = (os.environ.get(name) for name in ("TMPDIR", "TEMP", "TMP"))
    return next((Path(name) for name in named if name and os.path.isdir(name)), None) or Path(
        tempfile.gettempdir() if WINDOWS else "/tmp"
    )


def _check_free(folder: Path, need_mb: int, purpose: str, way: str) -> None:
    free_mb = shutil.disk_usage(folder).free // 2**20
    if free_mb < need_mb:
        raise Stop(
            f"Not enough disk space: {free_mb / 1000:.1f} GB are free on the disk of {folder}, and "
            f"{need_mb / 1000:.1f} GB are needed for {purpose}: {way}, then try again"
        )


# processes


def run_pytest(folder: Path, arguments: Sequence[str], **variables: str) -> None:
    """Run pytest in an environment, with a worker more than cores, since some tests wait for other processes."""
    cores = os.cpu_count() or 2
    workers = str(cores + 1 if cores < 8 else 8)
    # Rerun a test if Blender itself crashed (seen once in ed.undo_push), never if the test failed.
    after_a_crash = ["--reruns", "1", "--only-rerun", "no exception says this"]
    options = ["-n", workers, "--dist", "worksteal", *after_a_crash]
    run([program(folder), "-m", "pytest", *options, *arguments, *TEST_ARGS], **ONE_THREAD, **variables)


def run(command: Sequence[str], **variables: str) -> None:
    """Print a command and run it in the checkout; exit with its code if it fails."""
    print(shlex.join(command), flush=True)
    try:
        code = subprocess.run(command, cwd=ROOT, env={**environment(), **variables}, check=False).returncode
    except OSError as error:
        raise Stop(f"{command[0]} cannot be run ({error.strerror})") from error
    if code:
        sys.exit(code if code > 0 else 128 - code)


def environment() -> dict[str, str]:
    """The environment of commands. Without byte code, hundreds of child processes would each compile the backend."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    return {**kept, "PYTHONIOENCODING": "utf-8"} if WINDOWS else kept  # programs print into files and pipes


def answer_of(command: Sequence[str]) -> str:
    """The first line that a command prints; empty where it fails."""
    try:
        done = subprocess.run(command, capture_output=True, encoding="utf-8", errors="replace", check=False)
    except OSError:
        return ""
    return done.stdout.splitlines()[0] if done.returncode == 0 and done.stdout else ""


def main(arguments: Sequence[str]) -> NoReturn:
    """Run the target that the first argument names."""
    name, *others = arguments or ["help"]
    if name not in TARGETS:
        sys.exit(f"there is no target {name!r}: choose one of {', '.join(TARGETS)}")
    try:
        TARGETS[name](others)
    except Stop as stop:
        sys.exit(str(stop))
    except KeyboardInterrupt:
        sys.exit(130)
    sys.exit(0)


if __name__ == "__main__":
    main(sys.argv[1:])
