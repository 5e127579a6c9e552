"""A pytest plugin that gives our programs Windows' rules on Linux: `python -X warn_default_encoding -m pytest -p
support.windows_rules`, before anything of ours is imported.

- A file that this process or a child of it has open or mapped cannot be removed, renamed or replaced; a folder cannot
  be replaced, nor moved with such a file in it.
- Text is written with Windows' line ends unless the writer says otherwise, and text without a stated encoding is an
  error.
- In modules of our programs `os.name` is "nt", what Windows' os, signal and subprocess lack is missing, modules of Unix
  cannot be imported, links need a privilege, and the extension's processes must not open a console.

`sys.platform` stays Linux's: where our programs ask for it they call Windows' own functions, which cannot be had here.
Nor can paths with backslashes, limits on their length, and folders that ignore case.
"""

import builtins
import errno
import importlib.abc
import importlib.machinery
import io
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from types import ModuleType
from typing import Any

import pytest

PROGRAMS = ("primdiffusion", "blender_primdiffusion")
UNIX_MODULES = {"fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty"}
BY_PLATFORM = {
    ("primdiffusion.runtime.machine", "resource"),
    *((f"{program}.files.whole_files", "fcntl") for program in PROGRAMS),
}
"""Imports that stand below `if sys.platform != "win32"`, which pyright checks (`make types`)."""
UNIX_OS = {
    *("fork", "forkpty", "killpg", "wait", "setsid", "nice", "uname"),
    *("getuid", "geteuid", "getgid", "getegid", "getgroups", "getloadavg", "getpgid", "sched_getaffinity", "sysconf"),
    *("chown", "fchmod", "fchown", "mkfifo", "mknod", "statvfs", "fstatvfs", "sync", "readv", "pread", "pwrite"),
    *("posix_fadvise", "posix_fallocate", "sendfile", "O_CLOEXEC", "O_DIRECTORY", "O_NOFOLLOW", "O_NONBLOCK"),
}
WINDOWS_SIGNALS = {"SIGABRT", "SIGFPE", "SIGILL", "SIGINT", "SIGSEGV", "SIGTERM", "SIG_DFL", "SIG_IGN"}
NO_WINDOW = 0x08000000


def is_held(path: str) -> bool:
    """Whether this process or a child has a file, or one in a folder, open or mapped."""
    real = os.path.join(os.path.realpath(os.path.dirname(path) or "."), os.path.basename(path))
    below = real + os.sep
    for process in ("self", *_children()):
        if any(name == real or name.startswith(below) for name in _open_files(process)):
            return True
        try:
            with open(f"/proc/{process}/maps", "rb") as file:
                maps = file.read()
        except OSError:  # it has ended
            continue
        if os.fsencode(real) + b"\n" in maps or os.fsencode(below) in maps:
            return True
    return False


def _children() -> Iterator[str]:
    for task in os.listdir("/proc/self/task"):
        try:
            with open(f"/proc/self/task/{task}/children", encoding="ascii") as file:
                yield from file.read().split()
        except OSError:
            continue


def _open_files(process: str) -> Iterator[str]:
    folder = f"/proc/{process}/fd"
    try:
        descriptors = os.listdir(folder)
    except OSError:
        return
    for descriptor in descriptors:
        try:
            name = os.readlink(f"{folder}/{descriptor}")
        except OSError:
            continue
        if not os.path.isdir(name):
            yield name


def _refuse(path: Any) -> None:
    name = os.fsdecode(path)
    if is_held(name):
        raise PermissionError(errno.EACCES, "the file is in use by a process (rule of Windows)", name)


def _removing(remove: Callable[..., None]) -> Callable[..., None]:
    def removed(path: Any, *, dir_fd: int | None = None) -> None:
        if dir_fd is None:
            _refuse(path)
        remove(path, dir_fd=dir_fd)

    return removed


def _moving(move: Callable[..., None], *, over: bool) -> Callable[..., None]:
    def moved(source: Any, target: Any, **folders: Any) -> None:
        if not folders:
            _refuse(source)
            _refuse(target)
            if os.path.isdir(target):
                raise PermissionError(errno.EACCES, "a folder is there (rule of Windows)", os.fsdecode(target))
            if not over and os.path.lexists(target):
                raise FileExistsError(errno.EEXIST, "the name is taken (rule of Windows)", os.fsdecode(target))
        move(source, target, **folders)

    return moved


def _opening(opened: Callable[..., Any]) -> Callable[..., Any]:
    def with_line_ends(file, mode="r", buffering=-1, encoding=None, errors=None, newline=None, *rest, **options):
        if newline is None and "b" not in mode and set(mode) & set("wax+"):
            newline = "\r\n" if set(mode) & set("wax") else None
        # two levels further up is who opens
        encoding = encoding if "b" in mode else io.text_encoding(encoding, 2)
        return opened(file, mode, buffering, encoding, errors, newline, *rest, **options)

    return with_line_ends


class _Without(ModuleType):
    """A module without some of its names, and with others."""

    def __init__(self, module: ModuleType, lacks: Callable[[str], bool], **others: Any):
        super().__init__(module.__name__)
        self.__dict__.update(others, _module=module, _lacks=lacks)

    def __getattr__(self, name: str) -> Any:
        if self.__dict__["_lacks"](name):
            raise AttributeError(f"Windows' {self.__name__} has no {name}")
        return getattr(self.__dict__["_module"], name)


def _no_symlink(source: Any, target: Any, **_: Any) -> None:
    raise OSError(errno.EPERM, "a required privilege is not held (rule of Windows)", os.fsdecode(target))


def _no_kill(pid: int, number: int) -> None:
    raise AssertionError(f"os.kill({pid}, {number}) ends the process on Windows, whatever the signal")


def _processes(program: str) -> ModuleType:
    """subprocess, for a module of `program`."""

    def checked(options: dict[str, Any]) -> dict[str, Any]:
        if options.get("preexec_fn") is not None:
            raise ValueError("preexec_fn is not supported on Windows platforms")
        flags = options.pop("creationflags", 0)
        assert flags & NO_WINDOW or program != "blender_primdiffusion", "this opens a console beside Blender"
        return options

    class Popen(subprocess.Popen):
        def __init__(self, *arguments: Any, **options: Any):
            super().__init__(*arguments, **checked(options))

    def run(*arguments: Any, **options: Any) -> Any:
        return subprocess.run(*arguments, **checked(options))

    return _Without(subprocess, lambda _: False, Popen=Popen, run=run, CREATE_NO_WINDOW=NO_WINDOW)


def _builtins_of(program: str) -> dict[str, Any]:
    """The built-in functions for modules of a program: imports and files as on Windows."""
    replaced = {
        "os": _Without(os, UNIX_OS.__contains__, name="nt", symlink=_no_symlink, kill=_no_kill),
        "signal": _Without(
            signal, lambda name: (name.startswith("SIG") and name not in WINDOWS_SIGNALS) or name == "alarm"
        ),
        "subprocess": _processes(program),
    }

    def imported(name: str, globals=None, locals=None, fromlist=(), level: int = 0) -> Any:
        root = name.partition(".")[0]
        if level == 0 and root in UNIX_MODULES and ((globals or {}).get("__name__"), root) not in BY_PLATFORM:
            raise ModuleNotFoundError(f"Windows has no module {root}")
        module = builtins.__import__(name, globals, locals, fromlist, level)
        return replaced.get(name, module) if level == 0 else module

    return {**vars(builtins), "__import__": imported, "open": _opening(builtins.open)}


class _Loader(importlib.machinery.SourceFileLoader):
    def exec_module(self, module: ModuleType) -> None:
        module.__dict__["__builtins__"] = BUILTINS[module.__name__.partition(".")[0]]
        super().exec_module(module)


class _Finder(importlib.abc.MetaPathFinder):
    def find_spec(self, name: str, path: Any, target: Any = None) -> importlib.machinery.ModuleSpec | None:
        if name.partition(".")[0] not in PROGRAMS:
            return None
        spec = importlib.machinery.PathFinder.find_spec(name, path, target)
        if spec is not None and isinstance(spec.loader, importlib.machinery.SourceFileLoader):
            spec.loader = _Loader(spec.loader.name, spec.loader.path)
        return spec


@pytest.hookimpl(tryfirst=True)
def pytest_load_initial_conftests(early_config: pytest.Config) -> None:
    assert sys.flags.warn_default_encoding, "start Python with -X warn_default_encoding"
    early = [name for name in sys.modules if name.partition(".")[0] in PROGRAMS]
    assert not early, f"imported before the rules: {early}"
    early_config.addinivalue_line("filterwarnings", "ignore::EncodingWarning")  # of tests and packages
    early_config.addinivalue_line("filterwarnings", "error::EncodingWarning:(blender_)?primdiffusion")
    sys.meta_path.insert(0, _Finder())
    shutil._use_fd_functions = False  # Windows has none, and these would pass by the functions below
    io.open = _opening(io.open)
    os.remove = os.unlink = _removing(os.unlink)
    os.rename, os.replace = _moving(os.rename, over=False), _moving(os.replace, over=True)


BUILTINS = {program: _builtins_of(program) for program in PROGRAMS}
