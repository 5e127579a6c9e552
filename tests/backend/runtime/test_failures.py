"""What users read about exceptions."""

import pickle

import pytest
import torch
from primdiffusion import cli
from primdiffusion.files.regular_files import FileError, printable
from primdiffusion.formats.schema import FieldError
from primdiffusion.runtime.failures import PictureOutOfMemory, to_user_error, traceback_of


@pytest.mark.parametrize("error", [FieldError(("views", 2), "is 0: give 1"), PictureOutOfMemory(30, 40)])
def test_an_error_of_a_worker_process_says_the_same_in_its_parent(error):
    again = pickle.loads(pickle.dumps(error))
    assert (type(again), str(again), vars(again)) == (type(error), str(error), vars(error))


def test_torch_out_of_memory_on_the_cpu_is_named():
    with pytest.raises(RuntimeError) as error:
        torch.empty(10**15)
    failure = to_user_error(error.value)
    assert failure.kind == "out_of_memory"
    assert failure.sentence == "the machine ran out of memory when it asked for 4000000000000000 bytes more"


def test_cuda_out_of_memory_is_named():
    error = torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB. GPU 0 has a total capacity of ...")
    failure = to_user_error(error)
    assert failure.kind == "out_of_memory"
    assert failure.sentence == "the graphics card ran out of memory when it asked for 20.00 GiB more"
    assert failure.remedy


@pytest.mark.parametrize(
    ("error", "kind", "text"),
    [
        (MemoryError(), "out_of_memory", "ran out of memory"),
        (
            ValueError("seed -1 is out of range:\nchoose another"),
            "bad_input",
            "seed -1 is out of range: choose another",
        ),
        (
            FileNotFoundError(2, "No such file or directory", "x.npz"),
            "missing_file",
            "x.npz: no such file or directory",
        ),
        (FileNotFoundError("there is no checkpoint at x: train one"), "missing_file", "no checkpoint at x: train one"),
        (PermissionError(13, "Permission denied", "/out"), "unwritable", "/out: permission denied"),
        (OSError(28, "No space left on device", "/out/a"), "file_system", "/out/a: no space left on device"),
        (ModuleNotFoundError("No module named 'torch'"), "environment", "No module named 'torch'"),
    ],
)
def test_a_domain_error_is_one_sentence_of_its_kind(error, kind, text):
    failure = to_user_error(error)
    assert failure.kind == kind
    assert text in failure.sentence
    assert "\n" not in str(failure)


ESCAPE = "\x1b]0;owned\x07\x1b[2J\x9b31m\u202egnp.exe"
"""Sets a terminal's title, clears it, colours it, and turns letters round."""


@pytest.mark.parametrize(
    "error",
    [
        FileError(f"{ESCAPE}.glb", f"has joints {ESCAPE}", "rig it again"),
        FileNotFoundError(2, "No such file or directory", f"/{ESCAPE}"),
        PermissionError(13, "Permission denied", f"/{ESCAPE}"),
        OSError(ESCAPE),
        ValueError(f"version {ESCAPE}"),
        ImportError(ESCAPE),
    ],
    ids=lambda error: type(error).__name__,
)
def test_no_terminal_escape_of_a_file_is_in_a_sentence(error):
    assert "owned" in to_user_error(error).sentence
    assert str(to_user_error(error)).isprintable()


def test_no_terminal_escape_is_in_a_traceback():
    lines = traceback_of(RuntimeError(f"{ESCAPE}\nand more")).splitlines()
    assert all(line.isprintable() for line in lines)
    assert lines[-1] == "and more"


def test_letters_of_all_languages_stay_and_spaces_are_spaces():
    assert printable("\u5199\u771f\u3000\u5e74 Mu\u0308ller\u00a0b.png") == "\u5199\u771f \u5e74 Mu\u0308ller b.png"
    assert printable("a\tb\r\nc\udcff") == "a b  c?"


def test_the_command_line_prints_no_escape(tmp_path, capsys):
    path = tmp_path / f"{ESCAPE}.safetensors"
    for arguments in (["info", str(path)], ["captures", "export", str(path)], ["--traceback", "info", str(path)]):
        with pytest.raises(SystemExit):
            cli.main(arguments)
        said = capsys.readouterr()
        assert all(line.isprintable() for line in (said.out + said.err).splitlines())
        assert "owned" in said.err


@pytest.mark.parametrize("error", [KeyError("x"), RuntimeError("shape mismatch"), TypeError(), AssertionError()])
def test_a_defect_is_not_dressed_up_as_the_users_mistake(error):
    assert to_user_error(error) is None


@pytest.mark.parametrize(
    ("given", "shown"),
    [
        (f"there is no outfit '{'x' * 500}': choose", f"there is no outfit '{'x' * 75}...': choose"),
        (f"region is [0, [{', '.join(['1e+300'] * 30)}], 2]: give", "region is [0, [1e+300, "),
        (f"SMPL's file '/tmp/{'x' * 200}' is the user's", f"SMPL's file '/tmp/{'x' * 200}' is the user's"),
    ],
)
def test_long_values_of_a_file_are_cut_and_paths_stay(given, shown):
    sentence = str(to_user_error(ValueError(given)))
    assert sentence.startswith(shown)
    assert len(sentence) < 250
