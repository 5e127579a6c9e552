"""Blender's side of the pipe with the real child, and with children that misbehave."""

import json
import os
import time
from pathlib import Path

import pytest
from waiting import BACKEND, PYTHON, wait_for

from blender_primdiffusion.backend.child_process import LONGEST_LINE
from blender_primdiffusion.backend.client import (
    BackendClient,
    Died,
    Notification,
    Response,
    Silent,
    child_environment,
    death_sentence,
)


@pytest.fixture
def client():
    client = BackendClient(PYTHON, BACKEND)
    client.start()
    yield client
    client.kill()


def test_shutdown_ends_the_child_without_a_died_event(client):
    wait_for(client, lambda e: isinstance(e, Response))
    pid = client.pid
    client.shutdown()
    assert not client.alive
    assert not any(isinstance(event, Died) for event in client.poll())
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
    client.shutdown()


def test_a_child_that_dies_at_once_reports_its_exit_code_and_last_words(fake_child):
    client = fake_child("""
        print("libtorch is missing", file=sys.stderr)
        sys.exit(3)
    """)
    died = wait_for(client, lambda e: isinstance(e, Died))
    assert died.exit_code == 3
    assert died.stderr == ("libtorch is missing",)


def test_the_last_messages_of_a_dying_child_come_before_its_death(fake_child):
    client = fake_child("""
        for i in range(500):
            print(json.dumps({"jsonrpc": "2.0", "method": "news", "params": {"i": i}}))
    """)
    seen = []
    wait_for(client, lambda e: isinstance(e, Died), into=seen)
    assert [e.params["i"] for e in seen[:-1]] == list(range(500))
    assert isinstance(seen[-1], Died)


def test_lines_that_are_no_messages_are_kept_for_the_log_and_disturb_nothing(fake_child):
    client = fake_child("""
        print("Welcome to torch!")
        sys.stdout.buffer.write(b"\\xff\\xfe\\n")
        print("[1, 2]")
        print(json.dumps({"jsonrpc": "2.0", "id": 1, "result": {"version": "x"}}), flush=True)
        time.sleep(60)
    """)
    wait_for(client, lambda e: isinstance(e, Response))
    assert client.info["version"] == "x"
    assert any("Welcome to torch!" in line for line in client.stderr)


def test_silence_is_reported_once(fake_child):
    client = fake_child("time.sleep(60)", silence_s=0.4)
    silent = wait_for(client, lambda e: isinstance(e, Silent))
    assert silent.seconds >= 0.4
    time.sleep(0.6)
    assert client.poll() == []
    assert client.alive, "what to do about it is the caller's choice"


def test_heartbeats_are_no_events_but_end_the_silence(fake_child):
    client = fake_child(
        """
        print(json.dumps({"jsonrpc": "2.0", "method": "started", "params": {}}), flush=True)
        while True:
            print(json.dumps({"jsonrpc": "2.0", "method": "heartbeat", "params": {}}), flush=True)
            time.sleep(0.1)
        """,
        silence_s=3.0,
    )
    wait_for(client, lambda e: isinstance(e, Notification))
    end = time.monotonic() + 4.0
    while time.monotonic() < end:
        assert client.poll() == []
        time.sleep(0.05)


def test_time_without_polls_is_no_silence_of_the_child(fake_child):
    client = fake_child("time.sleep(60)", silence_s=1.5)
    client.poll()
    time.sleep(2.0)  # a suspended laptop, a modal dialogue of the system
    assert client.poll() == []


def test_a_child_that_closes_its_output_and_hangs_is_silent(fake_child):
    client = fake_child("os.close(1); time.sleep(60)", silence_s=0.4)
    wait_for(client, lambda e: isinstance(e, Silent))
    client.kill()
    assert not client.alive


def test_polling_a_child_that_reads_nothing_never_waits(fake_child):
    client = fake_child("time.sleep(60)")
    for _ in range(200):
        client.request("measure", {"padding": "x" * 10_000})  # far more than a pipe holds
    assert client.poll() == []
    assert client.alive


def test_a_poll_ends_when_its_time_is_over_and_a_flood_loses_no_message(fake_child, monkeypatch):
    monkeypatch.setattr("blender_primdiffusion.backend.client.POLL_S", 0.0)
    count = 4000
    client = fake_child(f"""
        for i in range({count}):
            sys.stdout.write(json.dumps({{"jsonrpc": "2.0", "method": "news", "params": {{"i": i}}}}) + "\\n")
    """)
    client._process.wait(300)
    assert len(client.poll()) == 1
    monkeypatch.undo()
    seen = []
    wait_for(client, lambda e: isinstance(e, Died), into=seen)
    assert [e.params["i"] for e in seen[:-1]] == list(range(1, count))


def test_a_flood_without_a_line_end_takes_no_memory_and_what_follows_is_heard(fake_child):
    client = fake_child("""
        for _ in range(100):
            sys.stdout.write("x" * 1_000_000)
        print()
        print(json.dumps({"jsonrpc": "2.0", "id": 1, "result": {"version": "x"}}), flush=True)
        time.sleep(60)
    """)
    wait_for(client, lambda e: isinstance(e, Response))
    assert len(client._output._line) < 2 * LONGEST_LINE


def test_what_the_pipe_does_not_take_at_once_arrives_later_whole(fake_child):
    client = fake_child("""
        time.sleep(0.5)
        for line in sys.stdin:
            request = json.loads(line)
            size = len(request["params"].get("padding", ""))
            print(json.dumps({"jsonrpc": "2.0", "id": request["id"], "result": {"size": size}}), flush=True)
    """)
    ids = [client.request("measure", {"padding": "x" * 100_000}) for _ in range(20)]
    seen = []
    wait_for(client, lambda e: isinstance(e, Response) and e.id == ids[-1], into=seen)
    assert [(e.id, e.result["size"]) for e in seen if e.id in ids] == [(id, 100_000) for id in ids]


def die_often(fake_child, count: int) -> None:
    """Children that die one after the other, half of them in the middle of a message: each is noticed at once."""
    first = fake_child("""
        print(json.dumps({"jsonrpc": "2.0", "id": 1, "result": {"version": "x"}}), flush=True)
        sys.stdout.write('{"jsonrpc": ' if os.getpid() % 2 else "")
        sys.stdout.flush()
        os._exit(3)
    """)
    module_path = Path(first._environment["PYTHONPATH"])
    for _ in range(count):
        client = BackendClient(PYTHON, module_path)
        client._command = [str(PYTHON), "-S", "-m", "primdiffusion.serve"]
        client.start()
        client._process.wait(300)
        events = client.poll()
        assert isinstance(events[0], Response)
        assert [event.exit_code for event in events[1:]] == [3]
        client.request("hello", {})
        assert client.poll() == []


def open_files() -> int:
    return len(list(Path("/proc/self/fd").iterdir())) if Path("/proc/self/fd").is_dir() else 0


@pytest.mark.parametrize("count", [20, pytest.param(1000, marks=pytest.mark.slow)])
def test_many_deaths_hang_nothing_and_leave_nothing_open(fake_child, count):
    before = open_files()
    die_often(fake_child, count)
    assert open_files() <= before + 3  # the three streams of the first, which is never polled


def test_the_bundled_package_goes_before_an_installed_one(fake_child):
    client = fake_child("""
        import primdiffusion
        print(json.dumps({"jsonrpc": "2.0", "method": "where", "params": {"file": primdiffusion.__file__}}), flush=True)
        time.sleep(60)
    """)
    where = wait_for(client, lambda e: isinstance(e, Notification)).params["file"]
    assert "backend" in Path(where).parts
    assert Path(where).is_relative_to(client._environment["PYTHONPATH"])


def test_kernels_are_kept_in_the_folder_given_for_them_and_byte_code_beside_its_sources(monkeypatch, tmp_path):
    monkeypatch.setenv("PYTHONPATH", "/blender/scripts")
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    environment = child_environment(tmp_path, tmp_path / "cache", {"EXTRA": "1"})
    assert "PYTHONDONTWRITEBYTECODE" not in environment
    assert environment["PYTHONPATH"] == str(tmp_path)
    assert Path(environment["NUMBA_CACHE_DIR"]).is_relative_to(tmp_path / "cache")
    assert "PYTHONPYCACHEPREFIX" not in environment
    assert environment["EXTRA"] == "1"


def test_a_module_in_the_current_folder_is_not_taken_for_the_backends(monkeypatch, tmp_path):
    (tmp_path / "primdiffusion.py").write_text("raise SystemExit(7)")
    monkeypatch.chdir(tmp_path)
    client = BackendClient(PYTHON, BACKEND)
    client.start()
    wait_for(client, lambda e: isinstance(e, Response))
    client.kill()


def test_a_killed_child_that_the_system_has_not_taken_away_yet_is_not_alive(client, monkeypatch):
    wait_for(client, lambda e: isinstance(e, Response))
    assert client.alive
    monkeypatch.setattr(client, "gone_within", lambda _seconds: False)
    monkeypatch.setattr(client._process, "poll", lambda: None)
    assert not client.kill(0.0)
    assert not client.alive
    monkeypatch.undo()
    assert client.gone_within(300.0)


def test_every_way_to_die_has_a_sentence():
    assert "memory" in death_sentence(-9)
    assert "signal 11" in death_sentence(-11)
    assert "0xc0000005" in death_sentence(0xC0000005)
    assert "exit code 1" in death_sentence(1)


@pytest.mark.parametrize(
    ("message", "fault"),
    [
        ({"id": [1], "result": {}}, "id"),
        ({"id": 1, "error": "all is lost"}, "error"),
        ({"id": 1, "error": {"code": 1, "message": "y", "data": {"kind": 3}}}, "error.data.kind"),
        ({"id": 1, "result": 3}, "result"),
        ({"id": 1}, "result"),
        ({"method": 3}, "method"),
        ({"method": "progress", "params": [1]}, "params"),
        ({"method": "progress", "params": {"id": 1, "stage": "load", "step": 1, "total": 2, "eta_s": 1e999}}, "eta_s"),
        (
            {"method": "progress", "params": {"id": 1, "stage": "load", "step": 1, "total": 2, "picture": "\0"}},
            "picture",
        ),
        ({"method": "ready", "params": {"ready": "yes"}}, "ready"),
        ({"id": 99, "result": {}}, "id"),
        ({"id": None, "error": {"code": -32700, "message": "the line is not JSON"}}, "id"),
        ('\'{"id": 1, "result": {"version"\'', "not JSON"),
        ("'{\"id\": 1, \"result\": \"' + 'x' * 5_000_000 + '\"}'", "longer than 4 MB"),
    ],
)
def test_a_malformed_message_ends_the_child_with_a_sentence(fake_child, message, fault):
    line = message if isinstance(message, str) else repr(json.dumps(message))
    client = fake_child(f"print({line}, flush=True)\ntime.sleep(60)")
    died = wait_for(client, lambda e: isinstance(e, Died))
    assert died.message == f"the backend was ended because it sent a malformed message ({fault})"
    assert client.gone_within(300)
    assert client.poll() == []


@pytest.mark.parametrize(
    ("method", "result", "fault"),
    [
        ("generate", {}, "person"),
        ("generate", {"person": "a", "seconds": 1e999}, "seconds"),
        ("variations", {"people": [{"seed": 1}], "seconds": 1}, "people[0].person"),
        ("merge", {"files": 3, "seconds": 1}, "files"),
    ],
)
def test_a_result_without_what_its_method_promises_ends_the_child(fake_child, method, result, fault):
    client = fake_child(f"""
        for line in sys.stdin:
            asked = json.loads(line)
            result = {{}} if asked["method"] == "hello" else {result!r}
            print(json.dumps({{"id": asked["id"], "result": result}}), flush=True)
    """.replace("inf", "1e999"))  # fmt: skip
    client.request(method, {})
    died = wait_for(client, lambda e: isinstance(e, Died))
    assert died.message == f"the backend was ended because it sent a malformed message ({fault})"


def test_a_second_answer_ends_the_child(fake_child):
    client = fake_child('print(\'{"id": 1, "result": {}}\\n\' * 2, flush=True)\ntime.sleep(60)')
    events = []
    wait_for(client, lambda e: isinstance(e, Died), into=events)
    assert [type(event) for event in events] == [Response, Died]
