"""Malformed messages of a broken child: each ends it with a sentence."""

import json

import pytest
from waiting import wait_for

from blender_primdiffusion.backend.client import Died, Response


@pytest.mark.parametrize(
    ("message", "fault"),
    [
        ({"id": [1], "result": {}}, "id"),
        ({"id": 1, "error": "all is lost"}, "error"),
        ({"id": 1, "error": {"code": "x", "message": "y"}}, "error.code"),
        ({"id": 1, "error": {"code": 1, "message": "y", "data": {"kind": 3}}}, "error.data.kind"),
        ({"id": 1, "result": 3}, "result"),
        ({"id": 1}, "result"),
        ({"id": 1, "result": {"memory_gb": "much"}}, "memory_gb"),
        ({"method": 3}, "method"),
        ({"method": "progress", "params": [1]}, "params"),
        ({"method": "progress", "params": {"id": 1, "stage": 7, "step": 1, "total": 2}}, "stage"),
        ({"method": "progress", "params": {"id": 1, "stage": "load", "step": "3", "total": 5}}, "step"),
        ({"method": "progress", "params": {"id": 1, "stage": "load", "step": 1, "total": 2, "picture": {}}}, "picture"),
        ({"method": "progress", "params": {"id": 1, "stage": "load", "step": 1, "total": 2, "eta_s": 1e999}}, "eta_s"),
        ({"method": "progress", "params": {"id": 1, "stage": "load", "step": 1}}, "total"),
        ({"method": "progress", "params": {"id": 1, "stage": "load", "step": -1, "total": 2}}, "step"),
        (
            {"method": "progress", "params": {"id": 1, "stage": "load", "step": 1, "total": 2, "picture": "\0"}},
            "picture",
        ),
        ({"method": "ready", "params": {"ready": "yes"}}, "ready"),
        ({"id": 99, "result": {}}, "id"),
        ({"id": None, "error": {"code": -32700, "message": "the line is not JSON"}}, "id"),
    ],
)
def test_a_malformed_message_ends_the_child_with_a_sentence(fake_child, message, fault):
    client = fake_child(f"print({json.dumps(message)!r}, flush=True)\ntime.sleep(60)")
    died = wait_for(client, lambda e: isinstance(e, Died))
    assert died.message == f"the backend was ended because it sent a malformed message ({fault})"
    assert client.gone_within(300)
    assert client.poll() == []


@pytest.mark.parametrize(
    ("method", "result", "fault"),
    [
        ("generate", {}, "person"),
        ("generate", {"person": 3, "seconds": 1}, "person"),
        ("generate", {"person": "a", "seconds": 1e999}, "seconds"),
        ("variations", {"people": [{"seed": 1}], "seconds": 1}, "people[0].person"),
        ("reconstruct", {"person": "a", "seconds": 1, "warnings": [None]}, "warnings[0]"),
        ("proxy", {"proxy": "a", "texture": "b", "betas": ["x"], "triangles": 1, "seconds": 1}, "betas[0]"),
        ("merge_frames", {"files": 3, "seconds": 1}, "files"),
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


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        ('\'{"id": 1, "result": {"version"\'', "not JSON"),
        ("'{' * 1000", "not JSON"),
        ("'{\"id\": 1, \"result\": \"' + 'x' * 5_000_000 + '\"}'", "longer than 4 MB"),
    ],
    ids=["cut off", "nested", "long"],
)
def test_a_line_that_begins_as_a_message_and_cannot_be_read_ends_the_child(fake_child, line, fault):
    client = fake_child(f"print({line}, flush=True)\ntime.sleep(60)")
    died = wait_for(client, lambda e: isinstance(e, Died))
    assert died.message == f"the backend was ended because it sent a malformed message ({fault})"
    assert client.gone_within(300)
