"""The zip a user installs: complete, reproducible, accepted by Blender; it generates with the real child."""

import hashlib
import json
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest
from engine_stage import pixels
from own_blender import report_of
from support import kernels
from support.errors import refused

import build_addon
import build_manual
from blender_primdiffusion.scene.splats import SPLATS_AVAILABLE

ROOT = Path(__file__).resolve().parents[2]
WEIGHTS = ROOT / "backend" / "primdiffusion" / "weights" / "default.safetensors"


@pytest.fixture(scope="module")
def archive(tmp_path_factory) -> Path:
    return build_addon.build(tmp_path_factory.mktemp("dist"))


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory) -> str:
    """Empty, for the checkpoint in the zip; until there is one, a tiny one."""
    if WEIGHTS.is_file():
        return ""
    from support.tiny import save_tiny_checkpoint

    return str(save_tiny_checkpoint(tmp_path_factory.mktemp("checkpoint") / "tiny.safetensors"))


@pytest.mark.any_blender
def test_the_same_tree_gives_the_same_bytes(archive, tmp_path):
    assert build_addon.build(tmp_path).read_bytes() == archive.read_bytes()


@pytest.mark.any_blender
def test_the_zip_holds_addon_backend_and_licence_and_nothing_stray(archive):
    names = zipfile.ZipFile(archive).namelist()
    assert names == sorted(names)
    wanted = {"blender_manifest.toml", "__init__.py", "LICENSE", "backend/client.py", "scene/human.py"}
    wanted |= {"gallery/Sample.human", "bundled/primdiffusion/human.py", "bundled/primdiffusion/body/data/body.npz"}
    wanted |= {f"motion/data/{name}" for name in ("poses.blend", "walk.npz", "idle.npz", "wave.npz", "turn.npz")}
    assert wanted <= set(names)
    assert not [name for name in names if "__pycache__" in name or name.endswith((".pyc", ".nbi", ".nbc"))]
    assert WEIGHTS.is_file() == ("bundled/primdiffusion/weights/default.safetensors" in names)


@pytest.mark.any_blender
def test_the_zip_holds_pages_whose_links_and_pictures_are_there(archive):
    names = zipfile.ZipFile(archive).namelist()
    assert {"manual/api.html", "manual/batch.html"} <= set(names)
    for name, content in build_manual.manual().items():
        if not name.endswith(".html"):
            continue
        text = content.decode()
        for target in re.findall(r'(?:href|src)="([^":#]+)', text):
            assert f"manual/{target}" in names, f"{name} leads to {target}"


@pytest.mark.parametrize(
    ("entry", "spoilt", "named"), [("license =", "licence =", "licen"), ('"Rigging"', '"Rig"', "invalid tag")]
)
def test_blenders_own_tool_accepts_the_zip_and_rejects_a_spoilt_manifest(entry, spoilt, named, archive, tmp_path):
    tool = build_addon.blender_extension_tool()
    assert tool is not None
    build_addon.validate(archive, tool)
    spoiled = tmp_path / "spoiled.zip"
    with zipfile.ZipFile(archive) as source, zipfile.ZipFile(spoiled, "w") as target:
        manifest = source.read("blender_manifest.toml").decode()
        target.writestr("blender_manifest.toml", manifest.replace(entry, spoilt))
        target.writestr("__init__.py", source.read("__init__.py"))
    with refused(build_addon.BuildError, named):
        build_addon.validate(spoiled, tool)


def test_an_index_makes_the_folder_a_repository_that_offers_the_zip(archive, tmp_path):
    (tmp_path / archive.name).write_bytes(archive.read_bytes())
    index = json.loads(build_addon.write_index(tmp_path, build_addon.blender_extension_tool()).read_text())
    (offered,) = index["data"]
    assert (offered["id"], offered["archive_url"]) == ("primdiffusion", f"./{archive.name}")
    assert offered["archive_size"] == archive.stat().st_size
    assert offered["archive_hash"] == f"sha256:{hashlib.sha256(archive.read_bytes()).hexdigest()}"
    assert {"website", "copyright", "permissions"} <= set(offered)


def test_the_installed_zip_generates_and_renders_a_human_and_blender_exits(archive, checkpoint, tmp_path):
    kernels.share_with_installed(tmp_path / "user")
    blend, picture = tmp_path / "shot.blend", tmp_path / "picture.png"
    report, done = report_of("installed_generate.py", archive, checkpoint, blend, 7, 3, picture, folder=tmp_path)
    assert report["outcome"] == ["FINISHED"]
    assert report["module"] == "bl_ext.user_default.primdiffusion"
    assert (report["volumes"], report["files"]) == (not SPLATS_AVAILABLE, 0), "no render has needed their files"
    assert (report["splats"] > 50_000) == SPLATS_AVAILABLE
    assert report["bones"] == 24
    assert report["backend_in_zip"]
    assert report["kernels_in_the_addon"] == []
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    red, green, blue, alpha = pixels(picture).transpose(2, 0, 1)
    assert alpha[0, 0] == 0.0
    human, cube = (slice(10, 20), 15), (16, 24)
    assert alpha[human].min() > 0.7
    assert alpha[cube] == 1.0
    assert red[cube] == green[cube] == blue[cube]
    assert np.ptp([red[human], green[human], blue[human]], axis=0).max() > 0.05
