"""A child spoken to by hand, line by line, as any JSON-RPC program could."""

import contextlib
import json
import queue
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

BUSY_STEPS = 1000
"""With the slow checkpoint this takes ten seconds and more: long enough to interrupt."""


class Conversation:
    def __init__(self, command: tuple[str, ...] = ("-P", "-m", "primdiffusion.serve")):
        pipe = subprocess.PIPE
        self.process = subprocess.Popen([sys.executable, *command], stdin=pipe, stdout=pipe, stderr=pipe)
        self.stray_lines: list[bytes] = []
        self.stderr = b""
        self._messages: queue.Queue[dict[str, Any] | None] = queue.Queue()
        self._threads = [threading.Thread(target=target, daemon=True) for target in (self._read, self._listen)]
        for thread in self._threads:
            thread.start()

    def _read(self) -> None:
        for line in self.process.stdout:
            try:
                self._messages.put(json.loads(line))
            except ValueError:
                self.stray_lines.append(line)
        self._messages.put(None)

    def _listen(self) -> None:
        for line in self.process.stderr:
            self.stderr += line

    def send_line(self, line: bytes) -> None:
        self.process.stdin.write(line + b"\n")
        self.process.stdin.flush()

    def send(self, id: int | str | None, method: str, /, **params: Any) -> None:
        self.send_line(json.dumps({"jsonrpc": "2.0", "id": id, "method": method, "params": params}).encode())

    def next(self, timeout_s: float = 300) -> dict[str, Any] | None:
        return self._messages.get(timeout=timeout_s)

    def until(self, wanted, timeout_s: float = 300) -> dict[str, Any]:
        """The first message that `wanted` accepts; others are passed over."""
        end, passed = time.monotonic() + timeout_s, []
        try:
            while (message := self.next(max(end - time.monotonic(), 0.001))) is not None:
                if wanted(message):
                    return message
                if message.get("method") != "heartbeat":
                    passed.append(message)
        except queue.Empty:
            raise AssertionError(f"nothing that was wanted in {timeout_s} s, at last {passed[-3:]}") from None
        raise AssertionError(f"the child ended: {self.stderr.decode()}")

    def answer(self, id: int | str | None, timeout_s: float = 300) -> dict[str, Any]:
        return self.until(lambda message: "method" not in message and message["id"] == id, timeout_s)

    def ask(self, id: int, method: str, /, **params: Any) -> dict[str, Any]:
        self.send(id, method, **params)
        return self.answer(id)

    def busy(self, id: int, out_dir: Path, checkpoint: Path, steps: int = BUSY_STEPS) -> None:
        """Starts a long generate and returns when it has taken three steps."""
        self.send(id, "generate", seed=1, steps=steps, out_dir=str(out_dir), checkpoint=str(checkpoint))
        self.until(
            lambda m: m.get("method") == "progress" and m["params"]["stage"] == "sample" and m["params"]["step"] > 2
        )

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self.process.stdin.close()
        try:
            self.process.wait(10)
        except subprocess.TimeoutExpired:
            self.process.kill()
        for thread in self._threads:
            thread.join(5)
