"""People folders: whole or not at all, the same everywhere. Need a MakeHuman asset folder."""

import hashlib
import os
import shutil
import signal
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import psutil
import pytest
from primdiffusion.capture.people_files import read_person
from primdiffusion.people import folder as folder_module
from primdiffusion.people.base_mesh import load_base_mesh
from primdiffusion.people.fitting import cover
from primdiffusion.people.folder import PeopleSet, is_there, make_people
from primdiffusion.people.person import make_person
from primdiffusion.people.wardrobe import SKIRTS
from support.errors import refused
from support.runs import within

OTHER_PROCESSOR = {
    "OPENBLAS_CORETYPE": "Prescott",
    "NPY_DISABLE_CPU_FEATURES": "AVX2 FMA3 AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL",
    "ATEN_CPU_CAPABILITY": "default",
}
"""Makes the libraries compute as on a machine without vector instructions newer than SSE."""


@pytest.fixture(scope="module")
def two(assets, tmp_path_factory):
    root = tmp_path_factory.mktemp("people")
    assert list(make_people(assets, PeopleSet(root, 3, 2), 1)) == [0, 1, 2]
    return root


def command(assets, out, *more):
    return [sys.executable, "-m", "primdiffusion.cli", "people", "--assets", str(assets.root), "--out", str(out), *more]


def digests(root):
    return {path.relative_to(root): hashlib.sha256(path.read_bytes()).hexdigest() for path in root.rglob("*.*")}


def test_missing_people_are_made_and_others_kept(assets, two):
    before = digests(two)
    kept = two / "person_000003/person.glb"
    moment = kept.stat().st_mtime_ns
    shutil.rmtree(two / "person_000004")
    assert not is_there(two / "person_000004", 4)
    assert list(make_people(assets, PeopleSet(two, 3, 2), 1)) == [1, 2]
    assert digests(two) == before
    assert kept.stat().st_mtime_ns == moment


def test_other_sets_of_people_are_rejected(assets, two):
    with refused(ValueError, "person_000003", "seed 4"):
        list(make_people(assets, PeopleSet(two, 4, 2), 1))
    with refused(ValueError, "person_000004"):
        list(make_people(assets, PeopleSet(two, 3, 1), 1))


@pytest.mark.parametrize(("seed", "count", "name"), [(0, 0, "count"), (-1, 2, "seed"), (2**63 - 1, 2, "seed")])
def test_sets_without_people_are_rejected(tmp_path, seed, count, name):
    with refused(ValueError, name):
        PeopleSet(tmp_path, seed, count)


def test_faces_differ_between_people_of_one_body(assets):
    base = load_base_mesh()
    first, second = (make_person(assets, base, seed).mesh.parts[0] for seed in (3, 4))
    assert len(first.vertices) != len(second.vertices) or not np.allclose(first.vertices, second.vertices)


def test_skin_far_under_cloth_is_left_out_and_its_rim_sunk(assets):
    base = load_base_mesh()
    (path, _), *_ = SKIRTS.items()
    garment = cover(assets, base, path)
    assert 1000 < garment.hidden.sum() < len(np.unique(base.faces))
    assert garment.sink.max() < 0.02
    head = np.unique(base.faces)[base.template[np.unique(base.faces), 1] > 0.42]
    assert not garment.hidden[head].any()
    assert (garment.sink[head] == 0).all()


@pytest.mark.slow
def test_any_processor_and_number_of_workers_gives_the_same_bytes(assets, tmp_path):
    environments = {"one": ("1", {}), "two": ("2", OTHER_PROCESSOR)}
    for name, (workers, more) in environments.items():
        options = ("--count", "3", "--seed", "40", "--workers", workers)
        subprocess.run(command(assets, tmp_path / name, *options), check=True, env={**os.environ, **more})
    assert digests(tmp_path / "one") == digests(tmp_path / "two")


@pytest.mark.slow
@pytest.mark.parametrize("blow", [signal.SIGINT, signal.SIGKILL])
def test_stopped_runs_leave_whole_people_and_no_workers(assets, tmp_path, blow):
    options = ("--count", "60", "--workers", "2")
    process = subprocess.Popen(command(assets, tmp_path, *options), stderr=subprocess.DEVNULL)
    try:
        assert within(300, lambda: len(list(tmp_path.glob("person_*"))) >= 2)
        workers = psutil.Process(process.pid).children(recursive=True)
        assert len(workers) >= 2
        process.send_signal(blow)
        assert process.wait(300) in (130, -signal.SIGKILL)
    finally:
        process.kill()
        process.wait()
    assert within(300, lambda: not any(worker.is_running() and worker.status() != "zombie" for worker in workers))
    for folder in tmp_path.glob("person_*"):
        assert is_there(folder, int(folder.name[-6:]))
        assert read_person(folder / "person.glb").betas.any()


def test_links_in_place_of_a_sample_and_in_it_are_not_followed(monkeypatch, tmp_path):
    sample = SimpleNamespace(mesh=None, attributes={}, betas=np.zeros(10))
    for name, value in (("make_person", sample), ("load_base_mesh", None), ("skeleton_of", None), ("glb", b"glb")):
        monkeypatch.setattr(folder_module, name, lambda *_, value=value: value)
    (tmp_path / "outside").mkdir()
    mine = tmp_path / "outside" / "person.glb"
    mine.write_text("mine")
    root = tmp_path / "people"
    (root / "person_000004").mkdir(parents=True)
    (root / "person_000004" / "person.glb").symlink_to(mine)
    (root / "person_000004" / "more").symlink_to(mine.parent)
    folder_module.write_person(None, root / "person_000004", 4)
    assert (root / "person_000004" / "person.glb").read_bytes() == b"glb"
    (root / "person_000005").symlink_to(mine.parent)
    with refused(OSError, "person_000005"):
        folder_module.write_person(None, root / "person_000005", 5)
    assert [path.name for path in mine.parent.iterdir()] == ["person.glb"]
    assert mine.read_text() == "mine"
    assert sorted(path.name for path in root.iterdir()) == ["person_000004", "person_000005"]
