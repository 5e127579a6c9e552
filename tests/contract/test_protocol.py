"""The child as the protocol promises it to anyone: lines in, lines out."""

import json
import subprocess
import sys

import numpy as np
import pytest
from conversation import BUSY_STEPS, Conversation
from PIL import Image
from primdiffusion import __version__
from primdiffusion.human_file import load_human

CANCELLED, DOMAIN_ERROR = -32001, -32002


@pytest.fixture
def own_child():
    child = Conversation()
    yield child
    child.close()


def test_hello_comes_before_torch_ready_names_the_device_and_shutdown_ends_the_child(own_child):
    own_child.send(1, "hello")
    hello = own_child.until(lambda m: True)
    assert hello["id"] == 1, "hello comes before ready"
    assert hello["result"]["version"] == __version__
    assert hello["result"]["protocol"] == 1
    assert hello["result"]["pid"] == own_child.process.pid
    assert hello["result"]["memory_gb"] >= hello["result"]["memory_free_gb"] > 0
    assert not hello["result"]["ready"]
    assert hello["result"]["device"] is None
    ready = own_child.until(lambda m: m.get("method") == "ready")["params"]
    assert ready["ready"]
    assert ready["problem"] is None
    assert ready["device"] in ("cpu", "cuda")
    assert own_child.ask(2, "hello")["result"]["device"] == ready["device"]
    assert own_child.ask(3, "shutdown")["result"] == {}
    assert own_child.process.wait(300) == 0


def test_heartbeats_come_while_the_child_is_idle(child):
    child.ask(900, "hello")
    for _ in range(3):
        child.until(lambda m: m.get("method") == "heartbeat")


def test_generate_reports_every_step_and_leaves_whole_files(child, checkpoint, tmp_path):
    out = tmp_path / "new" / "person ü"
    child.send(10, "generate", seed=5, steps=6, out_dir=str(out), checkpoint=str(checkpoint))
    steps = []

    def collect(message):
        if message.get("method") == "progress" and message["params"]["stage"] == "sample":
            assert message["params"]["id"] == 10
            steps.append((message["params"]["step"], message["params"]["total"], message["params"]["eta_s"]))
        return message.get("id") == 10 and "method" not in message

    result = child.until(collect)["result"]
    assert [step for step, _, _ in steps] == list(range(7))
    assert {total for _, total, _ in steps} == {6}
    assert steps[-1][2] == 0
    assert all(eta is not None for _, _, eta in steps[3:])
    assert (result["seed"], result["steps"]) == (5, 6)
    assert result["seconds"] > 0
    assert sorted(path.name for path in out.iterdir()) == [
        "depth.png", "front.png", "person.human.safetensors", "side.png",
    ]  # fmt: skip
    assert load_human(result["person"]).provenance["seed"] == 5
    with Image.open(result["preview"]) as picture:
        assert picture.size == (512, 512)
        assert np.asarray(picture).max() > 60


@pytest.mark.parametrize(
    ("line", "code", "id"),
    [
        (b"{", -32700, None),
        (b"\xff\xfe", -32700, None),
        (b"[" * 100_000, -32700, None),
        (b'{"jsonrpc":"2.0","id":1' + b"1" * 5000 + b"}", -32600, None),
        (b"[]", -32600, None),
        (b'{"jsonrpc": "2.0", "id": NaN, "method": "hello"}', -32600, None),
        (b'{"jsonrpc": "2.0", "id": 30, "method": "\\ud800"}', -32601, 30),
        (b"3", -32600, None),
        (b'{"jsonrpc": "2.0", "id": [1], "method": "hello"}', -32600, None),
        (b'{"id": 31, "method": "hello"}', -32600, 31),
        (b'{"jsonrpc": "2.0", "id": 32}', -32600, 32),
        (b'{"jsonrpc": "2.0", "id": 33, "method": "hello", "params": [1]}', -32602, 33),
        (b'{"jsonrpc": "2.0", "id": 34, "method": "dance"}', -32601, 34),
        (b'{"jsonrpc": "2.0", "id": 35, "method": "hello", "params": {"x": 1}}', -32602, 35),
        (b'{"jsonrpc": "2.0", "id": 36, "method": "generate", "params": {"seed": 1}}', -32602, 36),
        (b'{"jsonrpc": "2.0", "id": 37, "method": "generate", "params": {"seed": true, "out_dir": "x"}}', -32602, 37),
        (b'{"jsonrpc": "2.0", "id": 43, "method": "cancel"}', -32602, 43),
    ],
)
def test_a_malformed_line_gets_one_error_and_the_conversation_goes_on(child, line, code, id):
    child.send_line(line)
    error = child.answer(id)["error"]
    assert error["code"] == code
    assert "\n" not in error["message"]
    assert child.ask(50, "hello")["result"]["name"] == "primdiffusion"


def test_notifications_and_blank_lines_are_not_answered(child):
    child.send_line(b"")
    child.send_line(b'{"jsonrpc": "2.0", "method": "dance"}')
    child.send(60, "hello")
    assert child.until(lambda m: "method" not in m)["id"] == 60


def test_a_second_generate_is_rejected_while_one_runs_and_cancel_stops_the_first_within_a_step(
    child, checkpoint, slow_checkpoint, tmp_path
):
    first, second = tmp_path / "first", tmp_path / "second"
    child.busy(70, first, slow_checkpoint)
    error = child.ask(71, "generate", seed=1, out_dir=str(second), checkpoint=str(checkpoint))["error"]
    assert error["code"] == DOMAIN_ERROR
    assert error["data"]["kind"] == "busy"
    assert "70" in error["message"]
    assert not second.exists()

    assert child.ask(72, "cancel", id=999)["result"] == {"cancelled": False}
    assert child.ask(73, "cancel", id=70)["result"] == {"cancelled": True}
    after = []
    end = child.until(lambda m: after.append(m) or m.get("id") == 70)
    assert end["error"]["code"] == CANCELLED
    assert sum(m.get("method") == "progress" for m in after) <= 1
    assert not first.exists(), "a folder the cancelled job made is gone again"

    done = child.ask(74, "generate", seed=1, steps=1, size=32, out_dir=str(second), checkpoint=str(checkpoint))
    assert done["result"]["steps"] == 1


def test_cancelling_in_a_folder_that_was_there_keeps_what_was_in_it(child, slow_checkpoint, tmp_path):
    (tmp_path / "person.human.safetensors").write_bytes(b"an older person")
    child.busy(80, tmp_path, slow_checkpoint)
    child.ask(81, "cancel", id=80)
    child.answer(80)
    assert [path.name for path in tmp_path.iterdir()] == ["person.human.safetensors"]
    assert (tmp_path / "person.human.safetensors").read_bytes() == b"an older person"


def test_render_draws_a_saved_person_in_a_pose(child, checkpoint, tmp_path):
    person = child.ask(90, "generate", seed=2, steps=2, size=32, out_dir=str(tmp_path), checkpoint=str(checkpoint))[
        "result"
    ]

    raised, wrong, out = (tmp_path / name for name in ("raised.json", "wrong.json", "p.png"))
    raised.write_text(json.dumps([[0.0, 0.0, 0.0]] * 16 + [[0.0, 0.0, 1.2]] + [[0.0, 0.0, 0.0]] * 7))
    wrong.write_text("[1, 2]")
    child.ask(91, "render", human=person["person"], out=str(out), width=96, height=64, pose=str(raised))
    with Image.open(out) as picture:
        assert picture.size == (96, 64)
        assert np.asarray(picture).max() > 60
    error = child.ask(94, "render", human=person["person"], out=str(tmp_path / "x.png"), pose=str(wrong))["error"]
    assert error["code"] == DOMAIN_ERROR
    assert "72" in error["message"]
    assert not (tmp_path / "x.png").exists()


def test_a_folder_that_cannot_be_written_to_is_rejected_before_any_step(child, checkpoint, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("no folder")
    for id, out in ((110, blocked), (111, blocked / "below")):
        child.send(id, "generate", seed=1, steps=BUSY_STEPS, out_dir=str(out), checkpoint=str(checkpoint))
        seen = []
        error = child.until(lambda m, id=id, seen=seen: seen.append(m) or m.get("id") == id)["error"]
        assert (error["code"], error["data"]["kind"]) == (DOMAIN_ERROR, "unwritable")
        assert str(blocked) in error["message"]
        assert not any(m.get("method") == "progress" for m in seen)


def test_the_child_ends_within_a_step_and_tidies_up_when_its_parent_goes_while_it_samples(
    own_child, slow_checkpoint, tmp_path
):
    out = tmp_path / "out"
    own_child.busy(1, out, slow_checkpoint)
    own_child.process.stdin.close()
    assert own_child.process.wait(300) == 0
    assert not out.exists()


def test_the_child_ends_when_its_output_is_not_read(tmp_path):
    process = subprocess.Popen([sys.executable, "-m", "primdiffusion.serve"], stdin=-1, stdout=-1, stderr=-1)
    process.stdout.close()
    assert process.wait(300) == 0
    process.stdin.close()
    process.stderr.close()


def test_a_broken_environment_still_says_hello_and_names_the_problem(tmp_path):
    breaking = "import sys; sys.modules['torch'] = None; import primdiffusion.serve as serve; serve.main()"
    child = Conversation(("-c", breaking))
    child.send(1, "hello")
    seen: dict[object, dict] = {}  # in either order, as nothing is loaded
    child.until(lambda m: seen.update({m.get("method", m.get("id")): m}) or {1, "ready"} <= seen.keys())
    assert seen[1]["result"]["name"] == "primdiffusion"
    problem = seen["ready"]["params"]["problem"]
    assert problem is not None
    assert "torch" in problem
    error = child.ask(2, "generate", seed=1, out_dir=str(tmp_path / "out"))["error"]
    assert error["data"]["kind"] == "environment"
    assert not (tmp_path / "out").exists()
    child.close()


NOISY_AND_FAILING = """
import os, threading, time
import primdiffusion.serve as serve

def babble():
    while True:
        print("stray print")
        os.write(1, b"stray write\\n")
        time.sleep(0.002)

def fail(model, seeds, *_):
    if seeds == [1]:
        torch.empty(10**15)
    raise KeyError("a defect")

guard = serve.guard_streams
def guard_then_babble():
    streams = guard()
    threading.Thread(target=babble, daemon=True).start()
    return streams
serve.guard_streams = guard_then_babble

import torch
import primdiffusion.human as human
human.generate_batch = fail
serve.main()
"""


def test_out_of_memory_a_defect_and_stray_prints_disturb_neither_the_child_nor_the_conversation(checkpoint, tmp_path):
    child = Conversation(("-c", NOISY_AND_FAILING))
    params = {"out_dir": str(tmp_path / "out"), "checkpoint": str(checkpoint)}
    memory = child.ask(1, "generate", seed=1, **params)["error"]
    assert (memory["code"], memory["data"]["kind"]) == (DOMAIN_ERROR, "out_of_memory")
    assert "4000000000000000 bytes" in memory["message"]
    assert memory["data"]["remedy"]
    defect = child.ask(2, "generate", seed=2, **params)["error"]
    assert (defect["code"], defect["data"]["kind"]) == (-32603, "defect")
    assert child.ask(3, "hello")["result"]["ready"]
    assert not (tmp_path / "out").exists()
    child.close()
    assert child.process.returncode == 0
    assert child.stray_lines == []
    assert all(child.stderr.count(words) > 10 for words in (b"stray print", b"stray write"))
    assert b"Traceback" in child.stderr
