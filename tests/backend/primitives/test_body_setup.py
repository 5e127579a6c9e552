"""A body is found by its files' hashes, and loaded once."""

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
    module._body_setup.cache_clear()
    module._known_sha256.cache_clear()
    return tmp_path, setup.files, setup


def shuffled(content: bytes) -> bytes:
    """The same body with its vertices in the opposite order, in as many bytes."""
    template = np.asarray(body_arrays()["v_template"])
    was, now = (each.tobytes("A").decode("latin1").encode() for each in (template, template[::-1].copy("K")))
    assert content.count(was) == 1
    return content.replace(was, now)


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


def test_a_file_that_has_changed_is_rejected(files):
    folder, fingerprints, setup = files
    path = folder / NAMES[0]
    found(folder, fingerprints, setup)
    path.write_bytes(shuffled(path.read_bytes()))
    with refused(FileError, "SMPL_NEUTRAL.pkl", "changed"):
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
