"""The platforms that requirements are locked for: systems and Pythons of Blender, and torch's compute back ends."""

from __future__ import annotations

import dataclasses
import re


@dataclasses.dataclass(frozen=True)
class Target:
    """One lock file: a platform, a Python, a build of torch."""

    platform: str
    """The extension's name for it: linux_x86_64, linux_arm64, windows_x86_64, macos_arm64."""
    python: str
    """3.11 (Blender 5.0), 3.13 (5.1 and newer) or 3.14 (used by some Linux distributions)."""
    compute: str
    """cpu, cuda, apple."""
    uv_platform: str
    """uv's name for it, with the oldest system that torch has wheels for."""
    wheel_platforms: tuple[str, ...]
    """Patterns of platform tags that run there, best first."""
    torch_build: str = ""
    """Local version of a build that only download.pytorch.org has: cpu, cu130; empty: PyPI's build."""

    @property
    def name(self) -> str:
        """The lock's file name without its suffix."""
        return f"{self.platform}-py{self.python.replace('.', '')}-{self.compute}"

    @property
    def without_cuda(self) -> bool:
        """Whether torch's build needs no CUDA packages, although PyPI lists them as its requirements."""
        return bool(self.torch_build)

    def runs(self, tags: str) -> int | None:
        """The rank of a wheel with these tags (cp311-cp311-win_amd64), lower is better; None: it does not run."""
        pythons, abis, platforms = tags.split("-")
        version = self.python.replace(".", "")
        exact = f"cp{version}" in pythons.split(".") and f"cp{version}" in abis.split(".")
        stable = "abi3" in abis.split(".") and any(_not_newer(tag, version) for tag in pythons.split("."))
        pure = "none" in abis.split(".") and bool({"py3", "py2.py3", f"cp{version}"} & {*pythons.split("."), pythons})
        ranks = [
            rank
            for rank, pattern in enumerate((*self.wheel_platforms, "any"))
            if any(re.fullmatch(pattern, tag) for tag in platforms.split("."))
        ]
        if not ranks or not (exact or stable or pure):
            return None
        return ranks[0] + (0 if exact else 100)


def _not_newer(tag: str, version: str) -> bool:
    found = re.fullmatch(r"cp3(\d+)", tag)
    return found is not None and int(found[1]) <= int(version[1:])


_MAC = (r"macosx_1[1-4]_\d+_(?:arm64|universal2)", r"macosx_10_\d+_universal2")


def _linux(chip: str) -> tuple[str, ...]:
    return (
        f"manylinux_2_28_{chip}",
        rf"manylinux_2_(?:1\d|2[0-7])_{chip}",
        rf"manylinux(?:2014|2010|1|_2_5)_{chip}",
    )


def _on_linux(python: str) -> tuple[Target, ...]:
    intel, arm = ("linux_x86_64", python), ("linux_arm64", python)
    return (
        Target(*intel, "cpu", "x86_64-manylinux_2_28", _linux("x86_64"), "cpu"),
        Target(*intel, "cuda", "x86_64-manylinux_2_28", _linux("x86_64")),
        Target(*arm, "cpu", "aarch64-manylinux_2_28", _linux("aarch64"), "cpu"),
    )


def _elsewhere(python: str) -> tuple[Target, ...]:
    windows = ("windows_x86_64", python)
    return (
        Target(*windows, "cpu", "x86_64-pc-windows-msvc", ("win_amd64",)),
        Target(*windows, "cuda", "x86_64-pc-windows-msvc", ("win_amd64",), "cu130"),
        Target("macos_arm64", python, "apple", "aarch64-apple-darwin", _MAC),
    )


TARGETS = (
    *_on_linux("3.11"),
    *_elsewhere("3.11"),
    *_on_linux("3.13"),
    *_elsewhere("3.13"),
    *_on_linux("3.14"),
)
