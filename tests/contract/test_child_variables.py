"""What a process that the extension starts sees of the user's environment."""

import json
import os
import subprocess
import sys

import pytest
from waiting import BACKEND, PYTHON, wait_for

from blender_primdiffusion.backend import child_process
from blender_primdiffusion.backend.child_process import BLENDER, COMPUTING, NETWORK, NEVER, SYSTEM, passed_on
from blender_primdiffusion.backend.client import BackendClient, Notification, Response, child_environment
from blender_primdiffusion.backend.packages import clean_environment

SECRETS = ("AWS_SECRET_ACCESS_KEY", "GITHUB_TOKEN", "SSH_AUTH_SOCK", "HF_TOKEN", "PIP_TARGET")
CODE = (
    "PYTHONPATH", "PYTHONSTARTUP", "PYTHONHOME", "PYTHONINSPECT", "PYTHONWARNINGS", "PYTHONBREAKPOINT",
    "PYTHONUSERBASE", "PYTHONEXECUTABLE", "LD_PRELOAD", "LD_AUDIT", "DYLD_INSERT_LIBRARIES",
)  # fmt: skip


@pytest.fixture
def hostile(monkeypatch, tmp_path):
    """An environment that makes every Python that sees it write a file; returns that file."""
    marker, folder = tmp_path / "marker", tmp_path / "hostile"
    folder.mkdir()
    code = f"open({str(marker)!r}, 'a').write('seen')\n"
    for name in ("sitecustomize.py", "usercustomize.py", "startup.py"):
        (folder / name).write_text(code)
    monkeypatch.setenv("PYTHONPATH", str(folder))
    monkeypatch.setenv("PYTHONSTARTUP", str(folder / "startup.py"))
    monkeypatch.setenv("PYTHONINSPECT", "1")
    for name in SECRETS:
        monkeypatch.setenv(name, "secret")
    subprocess.run([sys.executable, "-c", ""], check=True, stdin=subprocess.DEVNULL)
    assert marker.exists()  # the trap works
    marker.unlink()
    return marker


def test_the_real_child_starts_and_ends_in_a_hostile_environment(hostile):
    client = BackendClient(PYTHON, BACKEND)
    client.start()
    wait_for(client, lambda event: isinstance(event, Response))
    wait_for(client, lambda event: isinstance(event, Notification) and event.method == "ready", timeout_s=300)
    client.end()
    assert client.gone_within(60)  # PYTHONINSPECT would wait at a prompt
    assert not hostile.exists()


def test_pip_and_venv_see_mirrors_and_proxies_and_nothing_else_of_the_user(hostile, monkeypatch, tmp_path):
    for name in ("https_proxy", "PIP_INDEX_URL", "SSL_CERT_FILE"):
        monkeypatch.setenv(name, "given")
    environment = clean_environment(tmp_path, tmp_path / "cache")
    assert {environment[name] for name in ("https_proxy", "PIP_INDEX_URL", "SSL_CERT_FILE")} == {"given"}
    assert not set(SECRETS) & set(environment)
    code = "import json, os; print(json.dumps(sorted(os.environ)))"
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert not {*SECRETS, *CODE} & set(json.loads(done.stdout))
    assert not hostile.exists()


def test_the_child_gets_no_proxies_and_no_settings_of_pip(monkeypatch):
    for name in ("HTTPS_PROXY", "https_proxy", "PIP_INDEX_URL", "SSL_CERT_FILE"):
        monkeypatch.setenv(name, "given")
    assert not {"HTTPS_PROXY", "https_proxy", "PIP_INDEX_URL", "SSL_CERT_FILE"} & set(child_environment(None, None, {}))


def test_what_the_backend_computes_with_is_passed_on():
    given = {
        "PATH": "/bin", "LC_ALL": "C", "SystemRoot": "C:\\Windows", "CUDA_VISIBLE_DEVICES": "1", "OMP_NUM_THREADS": "2",
        "PRIMDIFFUSION_DEVICE": "cpu", "LD_LIBRARY_PATH": "/cuda", "NVIDIA_VISIBLE_DEVICES": "all",
    }  # fmt: skip
    assert passed_on(COMPUTING, variables=given) == given


def test_no_table_lets_code_through():
    given = {name: "x" for name in (*CODE, *SECRETS, *NEVER)}
    assert passed_on(COMPUTING, NETWORK, BLENDER, variables=given) == {}


def test_names_in_the_tables_are_compared_without_case():
    assert all(name == name.upper() for table in (SYSTEM, COMPUTING, NETWORK, BLENDER) for name in table)
    assert os.environ.get("PATH", "") == child_process.passed_on().get("PATH", "")
