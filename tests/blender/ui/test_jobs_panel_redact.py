"""What a bug report tells, and what it must not."""

from __future__ import annotations

import json
from urllib.parse import quote

import pytest

from blender_primdiffusion.ui.jobs_panel import redact

pytestmark = pytest.mark.any_blender

NAMES = ("anna", "annas-laptop")
PRIVATE = ("anna", "Müller", "Secret", "Kunde", "server7", "freigabe")


@pytest.mark.parametrize(
    "path",
    [
        "/home/anna/Secret Film/shot.blend",
        "/home/anna",
        "/Users/anna/Documents/Kunde Müller/a.human.safetensors",
        "/mnt/Secret/x.vdb",
        r"C:\Users\anna\Secret Film\shot.blend",
        "C:/Users/anna/AppData/Secret.npz",
        r"\\server7\freigabe\Kunde Müller\shot.blend",
        "//server7/freigabe/shot.blend",
        "/home/Anna/x",
    ],
)
@pytest.mark.parametrize(
    "written",
    [
        str,
        lambda path: f"'{path}'",
        lambda path: json.dumps({"person": path}),
        lambda path: json.dumps(json.dumps({"person": path})),
        lambda path: quote(path),
        lambda path: quote(path, safe=""),
        lambda path: f"file://{quote(path)}",
        lambda path: f"cannot write {path}: no space left",
        lambda path: f'File "{path}", line 3',
        lambda path: f"--out={path} --seed 7",
    ],
)
def test_no_way_of_writing_a_path_reveals_a_user(path, written):
    redacted = redact(written(path), NAMES)
    for secret in PRIVATE:
        assert secret.lower() not in redacted.lower()
        assert quote(secret).lower() not in redacted.lower()


def test_what_helps_to_find_the_fault_stays():
    trace = 'File "/home/anna/.config/ext/primdiffusion/jobs/queue.py", line 3, in tick'
    assert redact(trace, NAMES) == 'File "<path>/primdiffusion/jobs/queue.py", line 3, in tick'
    assert redact(r"C:\Users\anna\env\Lib\site-packages\torch\nn.py:12") == r"<path>/site-packages\torch\nn.py:12"
    assert redact("cannot read /data/x/model.safetensors: damaged") == "cannot read <path>.safetensors: damaged"


@pytest.mark.parametrize(
    "text",
    ["step 3 / 30, 1.5 GB/s", "torch 2.13.0+cpu, Python 3.11/3.13", "a and/or b", "primdiffusion.generate(seed=7)", ""],
)
def test_what_is_no_path_stays_as_it_is(text):
    assert redact(text, NAMES) == text


def test_names_go_as_words_and_not_inside_of_others():
    assert redact("anna on annas-laptop: Anna, annabel", NAMES) == "<name> on <name>: <name>, annabel"
    assert redact("a user called a", ("a",)) == "a user called a"
