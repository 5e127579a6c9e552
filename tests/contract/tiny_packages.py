"""A package index of tiny wheels: the real venv, pip and hash checks in a few seconds."""

import base64
import contextlib
import hashlib
import http.server
import os
import sys
import threading
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path


def write_wheel(folder: Path, name: str, text: str, version: str = "1.0") -> Path:
    """A wheel of one module."""
    folder.mkdir(parents=True, exist_ok=True)
    about = f"{name}-{version}.dist-info"
    files = {
        f"{name}.py": text,
        f"{about}/METADATA": f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n",
        f"{about}/WHEEL": "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    record = "".join(f"{path},sha256={_digest(content)},{len(content)}\n" for path, content in files.items())
    wheel = folder / f"{name}-{version}-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        for path, content in {**files, f"{about}/RECORD": f"{record}{about}/RECORD,,\n"}.items():
            archive.writestr(path, content)
    return wheel


def _digest(content: str) -> str:
    return base64.urlsafe_b64encode(hashlib.sha256(content.encode()).digest()).rstrip(b"=").decode()


def write_packages(folder: Path, problem: str | None = None) -> list[Path]:
    """What the fake child needs: torch and tiny."""
    return [
        write_wheel(folder, "tiny", f"PROBLEM = {problem!r}\n"),
        write_wheel(folder, "torch", "__version__ = '0-tiny'\n"),
    ]


def write_lock(path: Path, wheels: list[Path], size: int | None = None) -> Path:
    """The lock of these wheels; of `size` bytes each, as far as it says."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = ["# a lock"]
    for wheel in wheels:
        name, version = wheel.name.split("-")[:2]
        digest = hashlib.sha256(wheel.read_bytes()).hexdigest()
        listed = size or wheel.stat().st_size
        lines.append(f"{name}=={version} --hash=sha256:{digest}  # {listed} bytes, 1000 installed")
    path.write_text("\n".join(lines) + "\n")
    return path


def own_index(monkeypatch, index: str = "") -> None:
    """pip looks nowhere but at this index; empty: nowhere."""
    for name in [name for name in os.environ if name.startswith("PIP_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("PIP_CONFIG_FILE", os.devnull)
    monkeypatch.setenv("PIP_RETRIES", "1")
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setenv("PIP_TRUSTED_HOST", "127.0.0.1")  # pip's cache is for hosts that it trusts
    monkeypatch.setenv("PIP_INDEX_URL", index or "http://127.0.0.1:9/simple")


def with_this_pip(monkeypatch, setup) -> None:
    """Environments get no pip of their own, which takes seconds: that of the tests' Python installs into them."""
    monkeypatch.setattr(setup, "_VENV", (*setup._VENV, "--without-pip"))
    monkeypatch.setattr(setup, "_pip", lambda python: [sys.executable, "-m", "pip", "--python", str(python)])


class TinyIndex(http.server.SimpleHTTPRequestHandler):
    """Serves a folder's wheels as an index; `stalls` names one that is begun and not ended while the event is clear."""

    folder: Path
    stalls: str = ""
    go_on: threading.Event
    asked: list[str]

    def do_GET(self) -> None:
        """A package's page, or a wheel."""
        self.asked.append(self.path)
        if self.path.startswith("/simple/"):
            name = self.path.rstrip("/").rsplit("/", 1)[1]
            links = "".join(f'<a href="/{wheel.name}">{wheel.name}</a>' for wheel in self.folder.glob(f"{name}-*.whl"))
            self._send(links.encode(), "text/html")
        else:
            self._send((self.folder / self.path.lstrip("/")).read_bytes(), "application/octet-stream")

    def _send(self, data: bytes, kind: str) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(data)))
        if kind != "text/html":  # as the package index says of its files
            self.send_header("Cache-Control", "max-age=365000000, immutable, public")
        self.end_headers()
        if self.stalls and self.path.startswith(f"/{self.stalls}-"):
            self.wfile.write(data[:100])
            self.go_on.wait(300)
            data = data[100:]
        with contextlib.suppress(OSError):
            self.wfile.write(data)

    def log_message(self, *_: object) -> None:
        """Nothing on the console."""


@contextlib.contextmanager
def served(folder: Path, stalls: str = "") -> Iterator[tuple[str, type[TinyIndex]]]:
    """An index on this machine: its address, and the handler with what was asked for."""
    own = type("Own", (TinyIndex,), {"folder": folder, "stalls": stalls, "asked": [], "go_on": threading.Event()})
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), own)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/simple", own
    finally:
        own.go_on.set()
        server.shutdown()
        server.server_close()


def until(condition, patience_s: float = 300.0) -> None:
    """Waits until it holds."""
    began = time.monotonic()
    while not condition():
        assert time.monotonic() - began < patience_s, "waited in vain"
        time.sleep(0.02)
