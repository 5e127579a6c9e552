"""Pictures while a person is made: of the guess at that step, seldom enough, and gone in the end."""

import itertools
import os
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from primdiffusion.commands import output
from primdiffusion.commands.edit import edit
from primdiffusion.commands.generate import generate
from primdiffusion.commands.output import PreviewBudget, PreviewFiles, draw_front_and_back, step_previews
from primdiffusion.commands.session import Session
from primdiffusion.diffusion.samplers import SamplerStep
from primdiffusion.formats.requests import (
    GenerateRequest,
    InpaintRequest,
    InterpolateRequest,
    TransferRequest,
    VaryRequest,
)

FILES = ["depth.png", "front.png", "person.human.safetensors", "side.png"]


class Clock:
    """A clock that the test advances."""

    def __init__(self):
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(output.time, "perf_counter", clock)
    return clock


@pytest.fixture
def always(monkeypatch):
    """Every step gets its picture."""
    monkeypatch.setattr(output, "INTERVAL_S", 0.0)
    monkeypatch.setattr(PreviewBudget, "allows", lambda _: True)


class Listener:
    """Keeps what is reported and looks at each picture at once, as a panel would."""

    def __init__(self):
        self.stages, self.pictures = [], []

    def __call__(self, stage, step, total, eta_s, /, **more):
        self.stages.append(stage)
        if "picture" in more:
            with Image.open(more["picture"]) as picture:
                self.pictures.append((step, picture.copy()))


def test_pictures_come_no_more_often_than_the_interval_and_take_a_quarter_of_the_time_at_most(clock):
    budget, times, spent = PreviewBudget(0.4), [], 0.0
    for _ in range(300):
        clock.now += 0.05
        if budget.allows():
            times.append(clock.now)
            with budget.measure():
                clock.now += 0.3
            spent += 0.3
    gaps = [later - earlier - 0.3 for earlier, later in itertools.pairwise(times)]
    assert min(gaps) >= 0.4 - 1e-9
    assert 0.2 < (spent - 0.3) / clock.now <= 0.25, "the first one, which loads and compiles, aside"


def test_at_most_the_last_two_pictures_are_there_and_none_in_the_end(tmp_path):
    with PreviewFiles(tmp_path, 2) as files:
        names = []
        for _ in range(4):
            names.append(files.next())
            names[-1].touch()
        assert sorted(tmp_path.iterdir()) == names[-2:]
        assert len(set(names)) == 4
    assert not list(tmp_path.iterdir())


def test_without_pixels_nothing_is_drawn(tmp_path):
    with step_previews(tmp_path, 0, pytest.fail) as picture:
        assert picture(SamplerStep(0, 2, 500, torch.zeros(1), torch.zeros(1))) is None


def test_generate_shows_what_the_person_will_look_like_and_leaves_no_pictures_behind(checkpoint, tmp_path, always):
    plain, shown = tmp_path / "plain", tmp_path / "shown"
    same = {"seed": 5, "steps": 4, "checkpoint": checkpoint, "size": 32}
    generate(GenerateRequest(out_dir=plain, **same), Session(), lambda *_: None)
    listener = Listener()
    generate(GenerateRequest(out_dir=shown, picture_px=24, **same), Session(), listener)
    assert [step for step, _ in listener.pictures] == [1, 2, 3]
    assert {(picture.size, picture.mode) for _, picture in listener.pictures} == {((24, 24), "RGBA")}
    assert all(picture.getchannel("A").getextrema() == (0, 255) for _, picture in listener.pictures)
    assert sorted(path.name for path in shown.iterdir()) == FILES
    for name in ("person.human.safetensors", "front.png"):
        assert (plain / name).read_bytes() == (shown / name).read_bytes(), "looking changes nothing"


def test_every_edit_shows_its_guesses(checkpoint, tmp_path, always):
    session, people = Session(), []
    for seed in (1, 2):
        request = GenerateRequest(seed=seed, out_dir=tmp_path / str(seed), steps=2, checkpoint=checkpoint, size=8)
        generate(request, session, lambda *_: None)
        people.append(tmp_path / str(seed) / "person.human.safetensors")
    same = {"person": people[0], "checkpoint": checkpoint, "size": 8, "steps": 4, "picture_px": 16}
    edits = {
        "vary": VaryRequest(out_dir=tmp_path / "v", **same),
        "interpolate": InterpolateRequest(out_dir=tmp_path / "i", other=people[1], **same),
        "inpaint": InpaintRequest(out_dir=tmp_path / "p", region=["top"], **same),
        "transfer": TransferRequest(out_dir=tmp_path / "t", source=people[1], region=["top"], harmonise=0.5, **same),
    }
    for method, request in edits.items():
        listener = Listener()
        edit(request, session, listener)
        assert len(listener.pictures) >= 2, method
        assert [stage for stage in listener.stages if stage != "sample"] == ["load", "write", "write"], method
        assert sorted(path.name for path in tmp_path.joinpath(request.out_dir).iterdir()) == FILES, method


def test_a_person_is_drawn_from_both_sides_in_halves_of_a_square(checkpoint, tmp_path):
    from primdiffusion.diffusion.checkpoint import load_checkpoint
    from primdiffusion.human import generate as generate_human

    human = generate_human(load_checkpoint(checkpoint, torch.device("cpu")), 3, 2)
    draw_front_and_back(tmp_path / "both.png", human, 64)
    with Image.open(tmp_path / "both.png") as picture:
        assert picture.size == (64, 64)
        columns = np.asarray(picture)[..., 3].max(0) > 128
    assert columns[:32].any()
    assert columns[32:].any()
    assert not columns[[0, 31, 32, 63]].any(), "nothing is cut off"


class Compiler:
    """A process that compiles until the test says that it has ended."""

    def __init__(self, target=None, daemon=None):
        self.starts, self.alive = 0, True

    def start(self):
        self.starts += 1

    def is_alive(self):
        return self.alive


def test_a_human_does_not_wait_for_the_compiler_and_comes_without_previews(checkpoint, tmp_path, always, monkeypatch):
    compiler = Compiler()
    monkeypatch.setattr(output, "is_compiled", lambda _: False)
    monkeypatch.setattr(output, "_compiler", [])
    monkeypatch.setattr(output.multiprocessing, "get_context", lambda _: SimpleNamespace(Process=lambda **_: compiler))
    listener, session, same = Listener(), Session(), {"checkpoint": checkpoint, "size": 8, "steps": 4}
    answer = generate(GenerateRequest(out_dir=tmp_path / "a", picture_px=8, **same), session, listener)
    varied = VaryRequest(out_dir=tmp_path / "b", person=answer.person, picture_px=8, **same)
    for made, folder in ((answer, "a"), (edit(varied, session, listener), "b")):
        assert (made.preview, made.side, made.depth) == (None, None, None)
        assert [path.name for path in (tmp_path / folder).iterdir()] == ["person.human.safetensors"]
    assert (listener.pictures, compiler.starts) == ([], 1)
    compiler.alive = False  # also if it has failed: then this process compiles
    assert edit(varied, session, listener).preview.is_file()
    assert len(listener.pictures) >= 2
    compiler.alive = True
    answer = generate(GenerateRequest(out_dir=tmp_path / "c", **same), session, listener)
    assert answer.preview.is_file(), "previews are all that a command line waits for"


def test_the_compiler_compiles_what_previews_need(monkeypatch):
    lowered = []
    monkeypatch.setattr(output, "end_with_parent", lambda: None)
    monkeypatch.setattr(output.os, "nice", lowered.append, raising=False)
    output._compile()
    assert output.is_compiled(output.march_tiles)
    assert lowered == [10]
    assert not output.skips_previews(8)


KERNEL = """
import numpy as np
from primdiffusion.render.cpu.compiled import is_compiled, kernel
from records import Values

@kernel
def add(taken, values):
    values.first[0] += 1

print(is_compiled(add))
add(np.zeros(1, np.int64), Values(np.zeros(1)))
print(is_compiled(add))
"""


def test_a_kernel_is_compiled_once_it_is_in_the_cache(tmp_path):
    script = tmp_path / "kernel.py"
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    for record, expected in (("Values", "False True"), ("Values", "True True"), ("Renamed", "False True")):
        script.write_text(KERNEL.replace("Values", record))  # a cache may name a record of an earlier version
        (tmp_path / "records.py").write_text(f"import typing\n{record} = typing.NamedTuple('{record}', first=list)")
        done = subprocess.run([sys.executable, script], env=environment, capture_output=True, text=True, check=True)
        assert done.stdout.split() == expected.split()
