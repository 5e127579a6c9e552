"""The reader of JSON on hostile texts."""

import json
import math
import os

import pytest
from primdiffusion.files.json_files import parse_json, parse_message, read_json
from primdiffusion.files.regular_files import FileError, is_plain_path
from support.errors import refused


@pytest.mark.parametrize(
    "text",
    ["", "{", "[" * 100_000, "[" * 70 + "]" * 70, "NaN", "[1e999]", '{"a": -Infinity}', "[" + "1" * 400 + "]",
     "[" + "1" * 5000 + "]", "[" + "[]," * 600_000 + "1]", b"\xff", 3],
)  # fmt: skip
def test_what_no_reader_can_use_is_one_short_reason(text):
    with pytest.raises(ValueError) as raised:
        parse_json(text)
    assert len(str(raised.value)) < 150


def test_integers_beyond_64_bits_are_floats_so_that_nothing_overflows():
    assert parse_json("[9223372036854775807, 9223372036854775808]") == [2**63 - 1, 2.0**63]
    assert parse_message("[" + "9" * 400 + ", NaN]")[0] == math.inf


def test_ordinary_json_comes_back(tmp_path):
    tree = {"a": [1, -2.5, None, True, "ä"], "b": {"c": {}}}
    (tmp_path / "a.json").write_text(json.dumps(tree))
    assert read_json(tmp_path / "a.json") == tree


def test_a_file_without_an_end_is_not_read(tmp_path):
    os.mkfifo(tmp_path / "pipe.json")
    with pytest.raises(PermissionError):
        read_json(tmp_path / "pipe.json")
    with (tmp_path / "large.json").open("wb") as file:
        file.truncate(2**26)
    with refused(FileError, "32 MB"):
        read_json(tmp_path / "large.json")


@pytest.mark.parametrize(
    "path", [r"\\server\share\a.pkl", "//server/a", r"\\.\PhysicalDrive0", "a\0b", "", "x" * 5000, "smb://a/b"]
)
def test_paths_of_other_machines_and_devices_are_not_plain(path):
    assert not is_plain_path(path)
    assert is_plain_path("/home/anna/smpl.pkl")
    assert is_plain_path(r"C:\Users\anna\smpl.pkl")
