"""A human from captures, with the real child."""

from pathlib import Path

import pytest
from capture_scenes import captured
from primdiffusion.human_file import load_human
from tiny_encoder import save_tiny_encoder

CANCELLED, DOMAIN_ERROR, INVALID_PARAMS = -32001, -32002, -32602
FIRST = "person_000000"


@pytest.fixture(scope="module")
def encoder(tmp_path_factory) -> Path:
    return save_tiny_encoder(tmp_path_factory.mktemp("encoder") / "tiny.safetensors")


@pytest.fixture(scope="module")
def captures(tmp_path_factory) -> Path:
    return captured(tmp_path_factory.mktemp("captures"), frames=2, passes=("img", "mask"))


@pytest.fixture
def asked(captures, encoder, tmp_path) -> dict:
    """Parameters of a good request."""
    out = str(tmp_path / "new" / "person ü")
    return {"capture": str(captures), "subject": FIRST, "out_dir": out, "checkpoint": str(encoder), "size": 32}


def test_reconstruct_reports_its_stages_and_leaves_whole_files(child, asked):
    child.send(1, "reconstruct", **asked, frame=1, views=2)
    stages = []
    while "method" in (message := child.until(lambda m: m.get("method") == "progress" or m.get("id") == 1)):
        stages.append((message["params"]["stage"], message["params"]["step"], message["params"]["total"]))
    assert stages == [("load", 0, 4), ("read", 1, 4), ("encode", 2, 4), ("write", 3, 4), ("write", 4, 4)]
    result = message["result"]
    assert (result["subject"], result["frame"], len(result["views"])) == (FIRST, 1, 2)
    assert result["seconds"] >= result["seconds_encoding"] > 0
    for name in ("person", "preview", "side", "depth"):
        assert Path(result[name]).parent == Path(asked["out_dir"])
        assert Path(result[name]).stat().st_size > 0
    assert load_human(result["person"]).betas.shape == (10,)
    assert not list(Path(asked["out_dir"]).glob(".*"))


@pytest.mark.parametrize(
    ("wrong", "code", "kind", "sentence"),
    [
        ({"subject": "nobody"}, DOMAIN_ERROR, "bad_input", "there is no subject 'nobody'"),
        ({"subject": None}, DOMAIN_ERROR, "bad_input", "several subjects: name one of them (person_000000"),
        ({"frame": 9}, DOMAIN_ERROR, "bad_input", "frames 0 to 1, not 9"),
        ({"capture": "/nowhere"}, DOMAIN_ERROR, "missing_file", "folder of captures /nowhere does not exist"),
        ({"checkpoint": "/nowhere.safetensors"}, DOMAIN_ERROR, "missing_file", "no encoder at /nowhere.safetensors"),
        ({"views": 0}, INVALID_PARAMS, None, "views is 0"),
        ({"views": "all"}, INVALID_PARAMS, None, "reconstruct.views"),
    ],
)
def test_an_error_names_what_was_wrong_and_leaves_nothing(child, asked, wrong, code, kind, sentence):
    error = child.ask(2, "reconstruct", **{**asked, **wrong})["error"]
    assert error["code"] == code
    assert sentence in error["message"]
    assert (error.get("data") or {}).get("kind") == kind
    assert not Path(asked["out_dir"]).parent.exists()


def test_a_cancel_ends_the_job_and_leaves_nothing(child, asked):
    child.send(3, "reconstruct", **asked)
    child.send(4, "cancel", id=3)
    assert child.answer(4)["result"] == {"cancelled": True}
    assert child.answer(3)["error"]["code"] == CANCELLED
    assert not Path(asked["out_dir"]).parent.exists()
