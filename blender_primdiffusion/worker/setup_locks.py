"""Locks: which wheels make the backend's environment on which machine. Files of pip's requirements format."""

from __future__ import annotations

import dataclasses
import hashlib
import re
from pathlib import Path

_REQUIREMENT = re.compile(
    r"(?P<name>[A-Za-z0-9._-]+)==(?P<version>[^\s;#]+) +--hash=sha256:(?P<sha256>[0-9a-f]{64})"
    r"(?: +# (?P<bytes>\d+) bytes, (?P<installed>\d+|\?) installed)?"
)
_INDEX = re.compile(r"--extra-index-url +(\S+)")
_UNPACKED_TO_PACKED = 3.0
"""For a wheel of which it is not known what it unpacks to; torch's CPU build for Linux has 3.6."""


@dataclasses.dataclass(frozen=True)
class Package:
    """One wheel of a lock."""

    name: str
    version: str
    sha256: str
    bytes: int
    """Of the file; 0 where the lock does not say."""
    installed: int
    """Bytes that it unpacks to, or about that."""

    @property
    def requirement(self) -> str:
        """A line for pip."""
        return f"{self.name}=={self.version} --hash=sha256:{self.sha256}"


@dataclasses.dataclass(frozen=True)
class Lock:
    """Every package of an environment, each with the hash of its one wheel."""

    path: Path
    digest: str
    """SHA-256 of the file: says whether an environment was made of this very lock."""
    indexes: tuple[str, ...]
    """Where to look beside PyPI."""
    packages: tuple[Package, ...]

    @property
    def download_bytes(self) -> int:
        """Of all wheels."""
        return sum(package.bytes for package in self.packages)

    @property
    def installed_bytes(self) -> int:
        """Of the environment, about."""
        return sum(package.installed for package in self.packages)


def read_lock(path: Path) -> Lock:
    """The lock in a file. Raises OSError, and ValueError for a line that is not `name==version --hash=sha256:...`."""
    data = path.read_bytes()
    indexes, packages = [], []
    for number, line in enumerate(data.decode("utf-8", "replace").splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        if index := _INDEX.fullmatch(line.strip()):
            indexes.append(index[1])
        elif found := _REQUIREMENT.fullmatch(line.strip()):
            packages.append(_package(found))
        else:
            raise ValueError(f"line {number} of {path} is not 'name==version --hash=sha256:...': {line.strip()[:60]!r}")
    if not packages:
        raise ValueError(f"{path} names no packages")
    return Lock(path, hashlib.sha256(data).hexdigest(), tuple(indexes), tuple(packages))


def _package(found: re.Match[str]) -> Package:
    size = int(found["bytes"] or 0)
    known = found["installed"] not in (None, "?")
    installed = int(found["installed"]) if known else int(size * _UNPACKED_TO_PACKED)
    return Package(found["name"], found["version"], found["sha256"], size, installed)


def locks_for(folder: Path, platform: str, python: tuple[int, int]) -> dict[str, Path]:
    """The locks in `folder` for a platform and a Python, by what they compute on: cpu, cuda, apple."""
    start = f"{platform}-py{python[0]}{python[1]}-"
    return {path.stem.removeprefix(start): path for path in sorted(folder.glob(f"{start}*.txt"))}


def grouped(packages: tuple[Package, ...], enough_bytes: int) -> list[tuple[Package, ...]]:
    """Packages in order, in groups that end when they hold `enough_bytes`: each is one run of pip, so what one run
    loses when it is stopped stays small, and its start is not paid for each small package."""
    groups: list[tuple[Package, ...]] = []
    group: list[Package] = []
    for package in packages:
        group.append(package)
        if sum(member.bytes for member in group) >= enough_bytes:
            groups.append(tuple(group))
            group = []
    return [*groups, tuple(group)] if group else groups
