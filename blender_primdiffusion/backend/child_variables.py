"""Which of the user's environment variables the processes that we start may see; all others stay here.

Blender is often started from a shell that holds keys and tokens, and sets variables of its own for its own Python. A
process that we start gets the variables in these tables, and what `client.child_environment` sets. None of them makes
a Python or the dynamic linker load other code, but for the folders of libraries that clusters need.
"""

from __future__ import annotations

import os
from collections.abc import Mapping

Table = Mapping[str, str]
"""Names, or beginnings of names with a "*", each with the reason for passing it on."""

SYSTEM: Table = {
    "PATH": "programs that torch and numba start (compilers), and on Windows the folders of libraries",
    "HOME": "caches and settings of libraries on Linux and macOS",
    "USERPROFILE": "the same on Windows",
    "USER": "names of torch's temporary folders",
    "LOGNAME": "the same, looked up first",
    "USERNAME": "the same on Windows",
    "APPDATA": "settings of libraries on Windows",
    "LOCALAPPDATA": "caches of libraries on Windows",
    "XDG_CACHE_HOME": "caches of libraries on Linux",
    "XDG_CONFIG_HOME": "settings of libraries on Linux",
    "TMPDIR": "temporary files on Linux and macOS",
    "TEMP": "temporary files on Windows",
    "TMP": "the same, for programs that look it up first",
    "LANG": "the encoding of file names",
    "LC_*": "the same, by category",
    "LANGUAGE": "the language of the system's error texts",
    "TZ": "times in records",
    "SYSTEMROOT": "Windows' sockets and random numbers do not start without it",
    "SYSTEMDRIVE": "paths of Windows' own libraries",
    "WINDIR": "the same, for older libraries",
    "COMSPEC": "Windows' shell, through which compilers are started",
    "PATHEXT": "endings of programs on Windows",
    "PROGRAMDATA": "settings of drivers on Windows",
    "PROGRAMFILES*": "where compilers and CUDA are on Windows",
    "NUMBER_OF_PROCESSORS": "the number of threads on Windows",
    "PROCESSOR_*": "the processor's kind on Windows (platform.machine)",
    "LD_LIBRARY_PATH": "where clusters keep CUDA; unlike LD_PRELOAD it loads no library that is not asked for",
    "DYLD_FALLBACK_LIBRARY_PATH": "the same on macOS; it is searched last",
}
"""Variables that programs need to run on this system."""
COMPUTING: Table = {
    "PRIMDIFFUSION_*": "our own settings: device, cache, assets",
    "CUDA_*": "which GPUs are used, where CUDA is installed, and its cache",
    "NVIDIA_*": "GPUs and drivers in containers",
    "HIP_VISIBLE_DEVICES": "which AMD GPUs are used",
    "ROCR_VISIBLE_DEVICES": "the same, one layer below",
    "HSA_OVERRIDE_GFX_VERSION": "AMD GPUs that ROCm does not name itself",
    "OMP_*": "threads of torch and numba",
    "KMP_*": "threads of Intel's OpenMP: how they wait and where they run",
    "MKL_*": "threads of MKL",
    "OPENBLAS_NUM_THREADS": "threads of numpy and scipy",
    "VECLIB_MAXIMUM_THREADS": "the same on macOS",
    "NUMEXPR_NUM_THREADS": "limits of clusters, set with the others",
    "NUMBA_*": "threads and cache of compiled kernels",
    "PYTORCH_*": "torch's allocator and fallback on Apple GPUs",
    "TORCH_*": "torch's instruction sets and cache",
    "TORCHINDUCTOR_CACHE_DIR": "the cache of torch.compile",
    "TRITON_CACHE_DIR": "the cache of kernels on GPUs",
    "SLURM_*": "processors and GPUs that a cluster has assigned",
}
"""Settings of what the backend computes with."""
NETWORK: Table = {
    "HTTP_PROXY": "the way to the package index",
    "HTTPS_PROXY": "the same",
    "ALL_PROXY": "the same",
    "NO_PROXY": "hosts that are reached directly",
    "SSL_CERT_FILE": "certificates of a company's network",
    "SSL_CERT_DIR": "the same",
    "REQUESTS_CA_BUNDLE": "the same, for the installer",
    "CURL_CA_BUNDLE": "the same, looked up next",
    "PIP_*": "the installer's mirror, certificate and time limits; what would install elsewhere is in NEVER",
    "NETRC": "the mirror's password, which a settings file may hold",
}
"""For set-up alone: no other program uses the network."""
BLENDER: Table = {
    "BLENDER_*": "folders of Blender's settings and scripts",
    "CYCLES_*": "Cycles' devices and kernels",
    "OCIO": "the colour management that a studio uses",
    "DISPLAY": "Blender's GPU back ends on X11",
    "XAUTHORITY": "the same: the right to use it",
    "WAYLAND_DISPLAY": "the same on Wayland",
    "XDG_RUNTIME_DIR": "the same: where its socket is",
}
"""For another Blender that renders captures or tests Cycles."""
NEVER = ("PIP_TARGET", "PIP_PREFIX", "PIP_ROOT", "PIP_USER", "PIP_PYTHON", "CUDA_INJECTION64_PATH")
"""Names that a pattern above contains, but that would install elsewhere or load a library into the process."""


def passed_on(*tables: Table, variables: Mapping[str, str] | None = None) -> dict[str, str]:
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
