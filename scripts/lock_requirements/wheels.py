"""Wheels from the package indexes: address, SHA-256, size, and unpacked size, read from the last bytes of the file."""

from __future__ import annotations

import dataclasses
import functools
import io
import json
import pathlib
import re
import urllib.error
import urllib.parse
import urllib.request
import zipfile

from targets import Target

PYPI = "https://pypi.org/simple"
PYTORCH = "https://download.pytorch.org/whl"
RECORDED = pathlib.Path(__file__).with_name("pytorch_wheels.json")
_TAIL = 1 << 16


class NoWheel(RuntimeError):
    """There is no such wheel, or its hash is not known."""


@dataclasses.dataclass(frozen=True)
class Wheel:
    filename: str
    sha256: str
    bytes: int
    installed: int | None
    """Unpacked bytes; None: unknown, because the wheel could not be read."""
    index: str | None
    """The index of the wheel if it is not PyPI."""


def wheel_of(name: str, version: str, target: Target) -> Wheel:
    """The wheel that pip would choose on this target. Raises NoWheel."""
    if name == "torch" and target.torch_build:
        return _of_pytorch(version, target)
    ranked = []
    for file in _files(name):
        found = re.fullmatch(r"[^-]+-([^-]+)(?:-\d[^-]*)?-([^-]+-[^-]+-[^-]+)\.whl", file["filename"])
        if found and found[1] == version and (rank := target.runs(found[2])) is not None:
            ranked.append((rank, file["filename"], file))
    if not ranked:
        raise NoWheel(f"PyPI has no wheel of {name} {version} for {target.name}")
    file = min(ranked)[2]
    return Wheel(file["filename"], file["hashes"]["sha256"], file["size"], _unpacked(file["url"], file["size"]), None)


def _of_pytorch(version: str, target: Target) -> Wheel:
    tag = "cp" + target.python.replace(".", "")
    platform = target.wheel_platforms[0]
    filename = f"torch-{version}+{target.torch_build}-{tag}-{tag}-{platform}.whl"
    index = f"{PYTORCH}/{target.torch_build}"
    recorded = json.loads(RECORDED.read_text(encoding="utf-8"))["wheels"].get(filename)
    found = _from_pytorch_index(index, filename)
    if found is not None:
        sha256, size, installed = found
        if recorded is not None and recorded["sha256"] != sha256:
            raise NoWheel(f"{filename}: {index} says {sha256}, {RECORDED.name} says {recorded['sha256']}")
        return Wheel(filename, sha256, size, installed, index)
    if recorded is None:
        raise NoWheel(f"{index} cannot be reached, and {RECORDED.name} does not list {filename}")
    return Wheel(filename, recorded["sha256"], recorded["bytes"], recorded["installed"], index)


def _from_pytorch_index(index: str, filename: str) -> tuple[str, int, int | None] | None:
    try:
        with urllib.request.urlopen(f"{index}/torch/", timeout=30) as page:
            html = page.read().decode("utf-8")
    except OSError:
        return None
    found = re.search(rf'href="([^"#]*{re.escape(urllib.parse.quote(filename))})#sha256=([0-9a-f]{{64}})"', html)
    if found is None:
        return None
    url = urllib.parse.urljoin(f"{index}/torch/", found[1])
    with urllib.request.urlopen(urllib.request.Request(url, method="HEAD"), timeout=30) as head:
        size = int(head.headers["Content-Length"])
    return found[2], size, _unpacked(url, size)


@functools.cache
def _files(name: str) -> list[dict]:
    request = urllib.request.Request(f"{PYPI}/{name}/", headers={"Accept": "application/vnd.pypi.simple.v1+json"})
    with urllib.request.urlopen(request, timeout=60) as page:
        return json.load(page)["files"]


@functools.cache
def _unpacked(url: str, size: int) -> int:
    """Unpacked bytes of a wheel, from the zip's directory at its end."""
    tail = min(_TAIL, size)
    while True:
        request = urllib.request.Request(url, headers={"Range": f"bytes={size - tail}-{size - 1}"})
        with urllib.request.urlopen(request, timeout=120) as answer:
            data = answer.read()
        try:
            return sum(entry.file_size for entry in zipfile.ZipFile(_EndOfFile(data, size)).infolist())
        except (OSError, zipfile.BadZipFile):
            if tail == size:
                raise
            tail = min(tail * 8, size)


class _EndOfFile(io.BytesIO):
    """The last bytes of a file at their original positions; reading elsewhere raises OSError."""

    def __init__(self, data: bytes, size: int):
        super().__init__(data)
        self._missing = size - len(data)

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        if whence == io.SEEK_SET:
            offset -= self._missing
            if offset < 0:
                raise OSError("these bytes have not been fetched")
        return super().seek(offset, whence) + self._missing

    def tell(self) -> int:
        return super().tell() + self._missing
