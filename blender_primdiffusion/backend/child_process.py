"""What a child process gets: of the user's environment variables those that it may see, and its streams, read and
written without a thread and without waiting.

Blender is often started from a shell that holds keys and tokens, and sets variables of its own for its own Python. A
process that we start gets the variables in these tables, and what `client.child_environment` sets; all others stay
here. None of them makes a Python or the dynamic linker load other code, but for the folders of libraries that clusters
need.

A child writes its output into a temporary file, which we read on a timer. Of the ways that need no thread on Linux,
Windows and macOS, only this one never blocks either side: the three have no common call to read a pipe without waiting,
and a full pipe stops the child while Blender is busy; a socket needs support in the child and can trigger a firewall
prompt. The file grows by 0.4 MB per hour of heartbeats. The child's input is a pipe that closes when Blender ends; what
the pipe does not take at once is written at the next tick.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import select
import sys
import tempfile
from collections.abc import Mapping
from typing import IO

if sys.platform == "win32":
    import msvcrt

SYSTEM = (
    "PATH", "PATHEXT", "COMSPEC",  # compilers and other programs that torch and numba start
    "HOME", "USERPROFILE", "APPDATA", "LOCALAPPDATA", "XDG_CACHE_HOME", "XDG_CONFIG_HOME",  # caches, settings
    "USER", "LOGNAME", "USERNAME",  # names of torch's temporary folders
    "TMPDIR", "TEMP", "TMP",
    "LANG", "LC_*", "LANGUAGE", "TZ",  # the encoding of file names, the system's error texts, times in records
    "SYSTEMROOT", "SYSTEMDRIVE", "WINDIR", "PROGRAMDATA", "PROGRAMFILES*",  # Windows' libraries, drivers and compilers
    "NUMBER_OF_PROCESSORS", "PROCESSOR_*",  # the processor's kind and the number of threads on Windows
    "LD_LIBRARY_PATH", "DYLD_FALLBACK_LIBRARY_PATH",  # where clusters keep CUDA; they load nothing unasked
)  # fmt: skip
"""Variables that programs need to run on this system; with a "*", all that begin so."""
COMPUTING = (
    "PRIMDIFFUSION_*",  # our own settings: device, cache, assets
    "CUDA_*", "NVIDIA_*", "HIP_VISIBLE_DEVICES", "ROCR_VISIBLE_DEVICES", "HSA_OVERRIDE_GFX_VERSION",  # GPUs and drivers
    "OMP_*", "KMP_*", "MKL_*", "OPENBLAS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS", "NUMEXPR_NUM_THREADS",  # threads
    "NUMBA_*", "PYTORCH_*", "TORCH_*", "TORCHINDUCTOR_CACHE_DIR", "TRITON_CACHE_DIR",  # allocators, compiled kernels
    "SLURM_*",  # processors and GPUs that a cluster has assigned
)  # fmt: skip
"""Settings of what the backend computes with."""
NETWORK = (
    "HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY", "NO_PROXY",
    "SSL_CERT_FILE", "SSL_CERT_DIR", "REQUESTS_CA_BUNDLE", "CURL_CA_BUNDLE",  # certificates of a company's network
    "PIP_*", "NETRC",  # the installer's mirror, its password, certificate and time limits
)  # fmt: skip
"""For set-up alone: no other program uses the network."""
BLENDER = (
    "BLENDER_*", "CYCLES_*", "OCIO",  # folders of settings and scripts, devices, colour management
    "DISPLAY", "XAUTHORITY", "WAYLAND_DISPLAY", "XDG_RUNTIME_DIR",  # Blender's GPU back ends on X11 and Wayland
)  # fmt: skip
"""For another Blender that renders captures or tests Cycles."""
NEVER = ("PIP_TARGET", "PIP_PREFIX", "PIP_ROOT", "PIP_USER", "PIP_PYTHON", "CUDA_INJECTION64_PATH")
"""Names that a pattern above contains, but that would install elsewhere or load a library into the process."""
READ_BYTES = 1 << 18
"""Largest piece of a child's output read at once, bytes."""
LONGEST_LINE = 1 << 22
"""Longer ones, which take too long to parse, are dropped; see `Output.lost_message`."""
LOG_BYTES = 1 << 16
LOG_LINES = 200


def passed_on(*tables: tuple[str, ...], variables: Mapping[str, str] | None = None) -> dict[str, str]:
    """The variables of this process (or of `variables`) that are in SYSTEM or in one of the `tables`.

    Names are compared without case: Windows does not distinguish it, and proxies are in lower case on Linux.
    """
    given = os.environ if variables is None else variables
    wanted = [name for table in (SYSTEM, *tables) for name in table]
    exact = {name for name in wanted if not name.endswith("*")}
    starts = tuple(name[:-1] for name in wanted if name.endswith("*"))
    return {
        name: value
        for name, value in given.items()
        if name.upper() not in NEVER and (name.upper() in exact or name.upper().startswith(starts))
    }


class Output:
    """A file that a child writes and that we read as it grows."""

    def __init__(self) -> None:
        """Raises OSError."""
        descriptor, self._name = tempfile.mkstemp(prefix="primdiffusion_")
        self.target: IO[bytes] = os.fdopen(descriptor, "wb", 0)
        """For the child: its stdout or stderr."""
        self._source = open(self._name, "rb", buffering=0)  # noqa: SIM115  closed by `close`
        if os.name != "nt":  # Windows removes no open file
            os.unlink(self._name)
        self._line = bytearray()
        self._dropping = False
        self.lost_message = False
        """A dropped line began with a brace, as messages do."""
        self.at_end = True
        """The last read has met the end of the file."""

    def lines(self) -> list[bytes]:
        """The lines that have been completed since the last call, of READ_BYTES at most."""
        if self._source.closed:
            return []
        read = self._source.read(READ_BYTES) or b""
        self.at_end = len(read) < READ_BYTES
        *whole, rest = read.split(b"\n")
        if whole:
            whole[0] = bytes(self._line) + whole[0]
            self._line.clear()
            if self._dropping:
                del whole[0]
        self._dropping = (self._dropping and not whole) or len(self._line) + len(rest) > LONGEST_LINE
        if self._dropping:
            self.lost_message |= self._line.startswith(b"{")
            self._line.clear()
        else:
            self._line += rest
        return whole

    def rest(self) -> bytes:
        """What was written after the last whole line, for a child that has ended."""
        rest = bytes(self._line)
        self._line.clear()
        return rest

    def log(self) -> list[str]:
        """The last lines of the whole output, read independently of `lines`."""
        if self._source.closed:
            return []
        place = self._source.tell()
        size = os.fstat(self._source.fileno()).st_size
        self._source.seek(max(size - LOG_BYTES, 0))
        text = self._source.read(LOG_BYTES) or b""
        self._source.seek(place)
        return [line.rstrip() for line in text.decode("utf-8", "replace").splitlines()[-LOG_LINES:]]

    def close(self) -> None:
        """Let go of the file, which goes with its last user."""
        self.target.close()
        self._source.close()
        if os.name == "nt":
            with contextlib.suppress(OSError):  # a child that has not ended holds it: a small file stays
                os.unlink(self._name)


class Input:
    """The writing end of a child's stdin. What does not fit the pipe waits for `flush`."""

    def __init__(self, pipe: IO[bytes]) -> None:
        """`pipe` is unbuffered (`bufsize=0` of Popen)."""
        self._pipe = pipe
        self._pending = bytearray()
        _stop_waiting_on(pipe.fileno())

    def send(self, data: bytes) -> None:
        """Write `data` now or with later calls of `flush`; a child that is gone takes nothing."""
        if not self._pipe.closed:
            self._pending += data
            self.flush()

    def flush(self) -> None:
        """Write what the pipe takes."""
        size = len(self._pending)
        while self._pending and size:
            try:
                written = os.write(self._pipe.fileno(), self._pending[: min(size, LOG_BYTES)])
            except BlockingIOError:
                return
            except OSError as error:
                if error.errno != errno.ENOSPC:  # the child is gone
                    self._pending.clear()
                    return
                size = min(size, LOG_BYTES) // 2  # Windows takes all of it or nothing
                continue
            del self._pending[:written]

    def close(self) -> None:
        """The end of the child's input; what is pending is dropped."""
        self._pending.clear()
        with contextlib.suppress(OSError):
            self._pipe.close()


def stdin_has_ended() -> bool:
    """Whether the other end of this process's stdin, a pipe, was closed: its parent is gone, or asks for an end.

    What arrives there is dropped. Never waits.
    """
    if sys.platform == "win32":
        return _windows_pipe_is_broken(0)
    while select.select([0], [], [], 0)[0]:
        if not os.read(0, 4096):
            return True
    return False


def _stop_waiting_on(descriptor: int) -> None:
    if sys.platform != "win32":  # Windows: os.set_blocking handles pipes from Python 3.12 on
        os.set_blocking(descriptor, False)
        return
    no_wait = ctypes.c_ulong(1)  # PIPE_NOWAIT
    handle = ctypes.c_void_p(msvcrt.get_osfhandle(descriptor))
    ctypes.windll.kernel32.SetNamedPipeHandleState(handle, ctypes.byref(no_wait), None, None)


def _windows_pipe_is_broken(descriptor: int) -> bool:
    if sys.platform != "win32":
        raise AssertionError("for Windows alone")
    kernel = ctypes.WinDLL("kernel32", use_last_error=True)
    handle = ctypes.c_void_p(msvcrt.get_osfhandle(descriptor))
    there = kernel.PeekNamedPipe(handle, None, 0, None, None, None)
    return not there and ctypes.get_last_error() == 109  # ERROR_BROKEN_PIPE
