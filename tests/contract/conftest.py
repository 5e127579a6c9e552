"""The real child and the real client, without Blender."""

import textwrap
from pathlib import Path

import pytest
from conversation import Conversation
from support.tiny import SLOW, save_tiny_checkpoint
from waiting import PYTHON

from blender_primdiffusion.backend.client import BackendClient


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory) -> Path:
    return save_tiny_checkpoint(tmp_path_factory.mktemp("checkpoint") / "tiny.safetensors")


@pytest.fixture(scope="session")
def slow_checkpoint(tmp_path_factory) -> Path:
    """The same people, in steps that take long enough to interrupt `BUSY_STEPS` of them on any machine."""
    return save_tiny_checkpoint(tmp_path_factory.mktemp("slow_checkpoint") / "slow.safetensors", SLOW)


@pytest.fixture(scope="session")
def child():
    """A real child, which is asked line by line. Starting one takes seconds: all tests share it."""
    child = Conversation()
    yield child
    child.close()


@pytest.fixture
def fake_child(tmp_path):
    """A client whose child is a script of a few lines in place of the backend."""
    clients = []

    def make(script: str, **settings) -> BackendClient:
        package = tmp_path / "backend" / "primdiffusion"
        package.mkdir(parents=True)
        (package / "__init__.py").touch()
        (package / "serve.py").write_text("import json, os, sys, time\n" + textwrap.dedent(script), encoding="utf-8")
        client = BackendClient(PYTHON, tmp_path / "backend", **settings)
        clients.append(client)
        client.start()
        return client

    yield make
    for client in clients:
        client.kill()
