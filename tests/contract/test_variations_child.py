"""Variations and pictures of the steps over the wire."""

from pathlib import Path

from conversation import BUSY_STEPS


def test_variations_name_each_picture_as_it_appears_and_whom_it_shows(child, checkpoint, tmp_path):
    out = tmp_path / "sheet ü"
    child.send(1, "variations", seeds=[3, 4], out_dir=str(out), steps=2, checkpoint=str(checkpoint), size=32)
    shown = []

    def collect(message):
        news = message.get("params", {})
        if news.get("stage") == "write":
            shown.append((news["index"], news["step"], news["total"], Path(news["picture"]).name))
        return message.get("id") == 1 and "method" not in message

    result = child.until(collect)["result"]
    assert shown == [(0, 1, 2, "3.png"), (1, 2, 2, "4.png")]
    for person in result["people"]:
        assert all(Path(person[name]).is_file() for name in ("person", "picture"))
    assert len(list(out.iterdir())) == 4


def test_a_long_generation_shows_pictures_and_cancelling_removes_them(child, slow_checkpoint, tmp_path):
    out = tmp_path / "person"
    params = {"seed": 1, "steps": BUSY_STEPS, "out_dir": str(out), "checkpoint": str(slow_checkpoint)}
    child.send(4, "generate", **params, picture_px=48)
    news = child.until(lambda message: message.get("params", {}).get("picture"))["params"]
    assert Path(news["picture"]).read_bytes().startswith(b"\x89PNG")
    child.send(5, "cancel", id=4)
    assert child.answer(4)["error"]["code"] == -32001
    assert not out.exists()
