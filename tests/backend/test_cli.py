"""The command line as a user meets it."""

import dataclasses
import itertools
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from primdiffusion import cli
from primdiffusion.commands import info
from primdiffusion.formats.schema import FieldError
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.human import framing, place
from primdiffusion.human_file import load_human
from primdiffusion.render.march import RELEASED, march
from support.errors import refused
from support.tiny import save_tiny_encoder

FILES = ["depth.png", "front.png", "person.human.safetensors", "side.png"]


@pytest.fixture(scope="module")
def person(checkpoint, tmp_path_factory):
    out = tmp_path_factory.mktemp("person")
    line = ["generate", "--seed", "5", "--steps", "2", "--out", str(out), "--size", "48"]
    cli.run([*line, "--checkpoint", str(checkpoint)])
    with Image.open(out / "front.png") as picture:
        assert picture.size == (48, 48)
    return out


def test_generate_writes_the_person_and_its_pictures(person):
    assert sorted(path.name for path in person.iterdir()) == FILES
    assert load_human(person / "person.human.safetensors").provenance["seed"] == 5


def test_a_batch_is_asked_for_and_written_together(checkpoint, tmp_path, capsys, fails):
    out = tmp_path / "out"
    line = ["generate", "--seed", "5", "--count", "3", "--steps", "1", "--size", "16", "--checkpoint", str(checkpoint)]
    cli.main([*line, "--out", str(out), "--batch", "2", "--attributes", "outfit=suit", "height=1.8"])
    assert sorted(path.name for path in out.iterdir()) == ["seed_000005", "seed_000006", "seed_000007"]
    assert all(sorted(path.name for path in folder.iterdir()) == FILES for folder in out.iterdir())
    assert capsys.readouterr().out.splitlines()[1].startswith(f"{out / 'seed_000006'}  seed 6, 1 steps")
    for seed in (5, 6, 7):
        meta = load_human(out / f"seed_{seed:06d}" / "person.human.safetensors").provenance
        assert (meta["seed"], meta["attributes"]) == (seed, {"outfit": "suit", "height": 1.8})
    for wrong, choices in (("outfit=robe", "jeans, suit"), ("beard=full", "outfit, height, weight")):
        failed = fails(*line, "--out", tmp_path / "none", "--attributes", wrong)
        assert failed.code == 1
        assert choices in failed.err
    assert not list(tmp_path.glob("none/*"))


def test_render_draws_a_pose_at_the_asked_size(person, tmp_path):
    theta = np.zeros((24, 3))
    theta[16, 2] = 1.2
    (tmp_path / "pose.json").write_text(json.dumps(theta.tolist()))
    pictures = {}
    human = str(person / "person.human.safetensors")
    for name, options in {
        "rest": [],
        "posed": ["--pose", str(tmp_path / "pose.json")],
        "side": ["--yaw", "90"],
        "clear": ["--background", "transparent"],
        "white": ["--background", "white"],
    }.items():
        out = tmp_path / f"{name}.png"
        cli.run(["render", human, "--out", str(out), "--size", "64", *options])
        pictures[name] = np.asarray(Image.open(out)).astype(int)
    assert pictures["rest"].shape == (64, 64, 3)
    assert np.abs(pictures["rest"] - pictures["posed"]).mean() > 1
    assert np.ptp(pictures["side"].sum((0, 2)).nonzero()[0]) < 40 < np.ptp(pictures["rest"].sum((0, 2)).nonzero()[0])
    assert pictures["clear"].shape == (64, 64, 4)
    assert pictures["clear"][0, 0, 3] == 0
    assert (pictures["white"][0, 0] == 255).all()


def test_render_draws_each_view_at_any_width_and_height(person, tmp_path):
    human, pictures = str(person / "person.human.safetensors"), {}
    for view in ("colour", "depth", "alpha", "boxes"):
        out = tmp_path / f"{view}.png"
        cli.run(["render", human, "--out", str(out), "--width", "72", "--height", "48", "--view", view])
        pictures[view] = np.asarray(Image.open(out)).astype(int)
        assert pictures[view].shape == (48, 72, 3)
    grey = pictures["alpha"]
    assert (grey == grey[..., :1]).all()
    assert (grey == 255).mean() > 0.02
    shown = {view: picture.max(-1) > 0 for view, picture in pictures.items()}
    assert (shown["boxes"] | ~shown["colour"]).all(), "boxes hold the person"
    for first, second in itertools.combinations(pictures, 2):
        assert np.abs(pictures[first] - pictures[second]).mean() > 1


def test_released_compositing_is_that_of_encoded_colours_and_backgrounds(person, tmp_path):
    """Released pictures are colour + (1 - alpha) background, all of them sRGB-encoded."""
    human, pictures = str(person / "person.human.safetensors"), {}
    for background in ("black", "white", "transparent"):
        line = ["render", human, "--out", str(tmp_path / "a.png"), "--size", "64", "--background", background]
        cli.run([*line, "--compositing", "released"])
        pictures[background] = np.asarray(Image.open(tmp_path / "a.png")).astype(float) / 255
    primitives = place(load_human(Path(human)))
    encoded = dataclasses.replace(primitives, rgb=encode_srgb(primitives.rgb))
    rendering = march(encoded, framing(primitives, 0.0, 64, 64), RELEASED)
    colour, alpha = rendering.rgb.numpy(), rendering.alpha.numpy()[..., None]
    assert ((alpha > 0.2) & (alpha < 0.8)).any()
    assert np.abs(pictures["black"] - colour).max() < 0.005
    assert np.abs(pictures["white"] - (colour + 1 - alpha)).max() < 0.005
    assert (
        np.abs(pictures["transparent"] * pictures["transparent"][..., 3:] - np.append(colour, alpha**2, 2)).max() < 0.01
    )
    for other in (["--view", "depth"], ["--step", "0.002"]):
        with refused(FieldError, "compositing"):
            cli.run([*line, "--compositing", "released", *other])


def test_info_tells_what_a_file_is(person, checkpoint, capsys, tmp_path):
    human, encoder = person / "person.human.safetensors", save_tiny_encoder(tmp_path / "encoder.safetensors")
    for file, name, value in ((human, "seed", 5), (checkpoint, "name", "tiny"), (encoder, "name", "tiny encoder")):
        cli.run(["info", str(file)])
        assert json.loads(capsys.readouterr().out)[name] == value
    cli.run(["info"])
    assert json.loads(capsys.readouterr().out)["device"] in ("cpu", "cuda")


def test_a_domain_error_is_one_sentence_exit_code_1_and_a_traceback_on_request(tmp_path, fails):
    line = ("generate", "--out", tmp_path / "out", "--checkpoint", tmp_path / "none.safetensors")
    failed = fails(*line)
    assert (failed.code, failed.err.count("\n")) == (1, 1)
    assert failed.err.startswith("primdiffusion: ")
    assert "none.safetensors" in failed.err
    assert not (tmp_path / "out").exists()
    traced = fails(*line, "--traceback")
    assert (traced.code, traced.err.splitlines()[-1]) == (1, failed.err.strip())
    assert "Traceback" in traced.err


@pytest.mark.parametrize(
    "line",
    [
        ["generate", "--out", "x", "--count", "0"],
        ["generate", "--out", "x", "--seed", "-1"],
        ["render", "nobody.human.safetensors", "--out", "x.png"],
        ["render", "nobody.human.safetensors", "--out", "x.png", "--step", "1e-9"],
        ["render", "nobody.human.safetensors", "--out", "x.png", "--yaw", "nan"],
        ["render", "nobody.human.safetensors", "--out", "x.png", "--frame", "3"],
        ["info", "nothing.safetensors"],
    ],
)
def test_wrong_values_fail_with_code_1_and_leave_nothing(line, tmp_path, monkeypatch, fails):
    monkeypatch.chdir(tmp_path)
    failed = fails(*line)
    assert (failed.code, failed.err.count("\n")) == (1, 1)
    assert list(tmp_path.iterdir()) == []


def test_a_picture_that_cannot_be_written_is_named_and_nothing_is(person, tmp_path, fails):
    line = ("render", person / "person.human.safetensors", "--size", 16, "--out")
    nowhere, folder = tmp_path / "no" / "x.png", tmp_path / "folder.png"
    folder.mkdir()
    for named in (nowhere, folder):
        failed = fails(*line, named)
        assert (failed.code, failed.err.count("\n")) == (1, 1)
        assert f"{named}: " in failed.err
    assert [path.name for path in tmp_path.rglob("*")] == ["folder.png"]


def test_a_folder_in_place_of_a_file_is_named_as_one(person, tmp_path, fails):
    human, out = person / "person.human.safetensors", tmp_path / "x.png"
    for line in (("render", tmp_path), ("render", human, "--pose", tmp_path), ("reconstruct", tmp_path)):
        assert f"{tmp_path} is a folder: give the file in it" in fails(*line, "--out", out).err


def test_a_human_is_not_overwritten_by_its_picture(person, fails):
    human = person / "person.human.safetensors"
    before = human.read_bytes()
    assert fails("render", human, "--size", 16, "--out", human).err.startswith("primdiffusion: out is ")
    assert human.read_bytes() == before


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a disk that is always full")
def test_a_full_disk_is_one_sentence_that_names_the_picture(person, tmp_path, fails, monkeypatch):
    human, plain_save = person / "person.human.safetensors", Image.Image.save

    def save(picture, place, **options):
        plain_save(picture, place, **options)
        with open("/dev/full", "wb", buffering=0) as full:
            full.write(b"x")

    monkeypatch.setattr(Image.Image, "save", save)
    failed = fails("render", human, "--size", 16, "--out", tmp_path / "x.png")
    assert (failed.code, failed.err.count("\n")) == (1, 1)
    assert f"{tmp_path / 'x.png'}: no space left on device" in failed.err
    assert list(tmp_path.iterdir()) == []


def test_wrong_usage_is_code_2(fails):
    assert fails("generate", "--stepz", "3").code == 2
    assert fails("dance").code == 2


def test_without_a_package_one_sentence_has_the_line_that_installs_it(tmp_path, monkeypatch, fails):
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    failed = fails("train", "--data", str(tmp_path), "--run", str(tmp_path / "run"), "--tracker", "tensorboard")
    assert failed.code == 1
    assert 'which is not installed: run pip install "primdiffusion[tracking]"' in failed.err


def test_a_defect_keeps_its_traceback_and_has_a_code_of_its_own(monkeypatch, fails):
    def broken(*_):
        raise KeyError("a defect")

    monkeypatch.setattr(info, "info", broken)
    failed = fails("info")
    assert failed.code == cli.DEFECT
    assert "Traceback" in failed.err


def test_an_interrupt_is_130_without_a_traceback_and_leaves_nothing(monkeypatch, checkpoint, tmp_path, fails):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("primdiffusion.commands.generate.generate_batch", interrupted)
    failed = fails("generate", "--out", tmp_path / "out", "--checkpoint", checkpoint)
    assert failed == (cli.INTERRUPTED, "", "primdiffusion: interrupted\n")
    assert not (tmp_path / "out").exists()


def test_help_does_not_load_torch():
    code = """
import contextlib, sys
from primdiffusion import cli
from primdiffusion.commands.options import OPTIONS
for line in ["", *OPTIONS]:
    with contextlib.suppress(SystemExit):
        cli.main([*line.split(), "--help"])
    assert "torch" not in sys.modules, line
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "primdiffusion payloads encode" in done.stdout


@pytest.mark.skipif(os.name == "nt", reason="names of files are text there")
def test_a_name_that_is_no_utf8_is_printed_and_closed_streams_do_no_harm():
    code = "import os; from primdiffusion.cli import main; main(['--help']); print(os.fsdecode(b'\\xff'))"
    environment = {**os.environ, "PYTHONIOENCODING": "utf-8:strict"}
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, env=environment, check=True)
    assert run.stdout.endswith(b"\xff\n")
    closed = subprocess.run(["sh", "-c", '"$0" -c "$1" >&- 2>&-', sys.executable, code], check=False)
    assert closed.returncode == 0


@pytest.mark.skipif(os.name == "nt", reason="pipes break in another way there")
@pytest.mark.parametrize(("line", "unbuffered"), [(("--help",), "1"), (("generate", "--help"), "")])
def test_a_reader_that_has_gone_ends_a_command_silently(line, unbuffered):
    command = [sys.executable, "-m", "primdiffusion", *line]
    reader, writer = os.pipe()
    os.close(reader)
    environment = {**os.environ, "PYTHONUNBUFFERED": unbuffered}
    with os.fdopen(writer, "wb") as pipe:
        done = subprocess.run(command, stdout=pipe, stderr=subprocess.PIPE, env=environment, check=False)
        assert (done.returncode, done.stderr) == (1, b"")
        both = subprocess.run(command, stdout=pipe, stderr=pipe, env=environment, check=False)
        assert both.returncode == 1


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device of Linux")
def test_results_for_which_the_disk_has_no_room_are_one_sentence():
    with open("/dev/full", "wb") as full:
        done = subprocess.run(
            [sys.executable, "-m", "primdiffusion", "info"], stdout=full, stderr=subprocess.PIPE, check=False
        )
    assert (done.returncode, done.stderr.count(b"\n")) == (1, 1)
    assert b"no space left on device" in done.stderr.lower()


@pytest.mark.parametrize(("encoding", "printed"), [("cp1252", b"\\u0417"), ("utf-8", "З".encode())])
def test_a_name_that_the_terminal_cannot_show_is_printed_all_the_same(encoding, printed):
    program = "from primdiffusion import cli; cli._repair_streams(); print('\\u0417')"
    environment = {**os.environ, "PYTHONIOENCODING": encoding}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, check=True)
    assert done.stdout.strip() == printed
