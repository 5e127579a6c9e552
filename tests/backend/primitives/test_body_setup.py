"""A body's files are read once: what was hashed is what is loaded, even if the files change in between."""

import hashlib
import os
import shutil

import numpy as np
import pytest
from primdiffusion.files.regular_files import FileError
from primdiffusion.primitives import body_setup as module
from primdiffusion.primitives.body_setup import body_setup_from_files, find_body_setup
from released_files import body_arrays, save_body
from support.errors import refused

NAMES = ("SMPL_NEUTRAL.pkl", "smpl_uv.obj")


@pytest.fixture(scope="module")
def loaded(tmp_path_factory):
    """A body and its setup."""
    folder = tmp_path_factory.mktemp("body")
    smpl, uv = save_body(folder)
    return folder, body_setup_from_files(smpl, (uv,))


@pytest.fixture
def files(loaded, tmp_path):
    """Copies of the body's files, and the setup that tells their hashes."""
    folder, setup = loaded
    for name in NAMES:
        shutil.copy(folder / name, tmp_path)
    module._loaded.clear()
    module._sha256.cache_clear()
    return tmp_path, setup.files, setup


def shuffled(content: bytes) -> bytes:
    """The same body with its vertices in the opposite order, in as many bytes."""
    template = np.asarray(body_arrays()["v_template"])
    was, now = (each.tobytes("A").decode("latin1").encode() for each in (template, template[::-1].copy("K")))
    assert content.count(was) == 1
    return content.replace(was, now)


def overwrite(path, content):
    """In place, and with the times that it had."""
    before = path.stat()
    with path.open("r+b") as file:
        file.write(content)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


def after_hashing(monkeypatch, change):
    """Have `change` happen after the files were read and hashed, and before they are loaded."""
    load = module.load_body

    def loading(*files, **more):
        change()
        return load(*files, **more)

    monkeypatch.setattr(module, "load_body", loading)


def found(folder, files, setup):
    return find_body_setup(
        module.BodyFiles(
            *(
                module.FileFingerprint(str(folder / NAMES[0]), files.smpl.sha256),
                (module.FileFingerprint(str(folder / NAMES[1]), files.uv[0].sha256),),
            )
        ),
        setup.anchors.rest_half_extent,
        [],
    )


@pytest.mark.parametrize("how", ["overwritten", "replaced"])
def test_what_was_hashed_is_loaded_after_the_files_have_changed(files, monkeypatch, how):
    folder, fingerprints, setup = files

    def change():
        path = folder / NAMES[0]
        if how == "replaced":
            other = path.with_suffix(".other")
            other.write_bytes(shuffled(path.read_bytes()))
            os.replace(other, path)
        else:
            overwrite(path, shuffled(path.read_bytes()))
        (folder / NAMES[1]).write_text("f 1/1 2/2 3/3\n")

    after_hashing(monkeypatch, change)
    assert found(folder, fingerprints, setup).body.template.equal(setup.body.template)


def test_what_is_recorded_of_a_new_body_is_what_was_loaded(files, monkeypatch):
    folder, fingerprints, setup = files
    smpl, uv = (folder / name for name in NAMES)
    after_hashing(monkeypatch, lambda: overwrite(smpl, shuffled(smpl.read_bytes())))
    made = body_setup_from_files(smpl, (uv,))
    assert made.body.template.equal(setup.body.template)
    assert made.files.smpl.sha256 == fingerprints.smpl.sha256 != hashlib.sha256(smpl.read_bytes()).hexdigest()


def test_a_file_that_is_changed_in_place_under_the_same_times_and_size_is_rejected(files):
    folder, fingerprints, setup = files
    path = folder / NAMES[0]
    for name, file in zip(NAMES, (fingerprints.smpl, *fingerprints.uv), strict=True):
        module._found(module.FileFingerprint(str(folder / name), file.sha256), ())  # is remembered by times and size
    overwrite(path, shuffled(path.read_bytes()))
    with refused(FileError, "SMPL_NEUTRAL.pkl"):
        found(folder, fingerprints, setup)


def test_a_body_is_loaded_once(files, monkeypatch):
    folder, fingerprints, setup = files
    first = found(folder, fingerprints, setup)
    monkeypatch.setattr(module, "load_body", lambda *_, **__: pytest.fail("it was loaded again"))
    assert found(folder, fingerprints, setup).body is first.body


@pytest.mark.parametrize("count", [0, 3])
def test_a_human_names_one_or_two_files_of_texture_coordinates(files, count):
    folder, fingerprints, setup = files
    smpl = module.FileFingerprint(str(folder / NAMES[0]), fingerprints.smpl.sha256)
    uv = module.FileFingerprint(str(folder / NAMES[1]), fingerprints.uv[0].sha256)
    with refused(FileError, str(count)):
        find_body_setup(module.BodyFiles(smpl, (uv,) * count), setup.anchors.rest_half_extent, [])
