"""The viewer's zip: no code that downloads, accepted by Blender; in it humans are opened, posed, reshaped, exported."""

import ast
import re
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from own_blender import report_of
from support.errors import refused

pytest.importorskip("torch", reason="the gallery's humans are made by the backend")

from export_people import person
from primdiffusion.human_file import load_human, save_human

import build_addon
from blender_primdiffusion.backend.environment import NOT_INSTALLED


@pytest.fixture(scope="module")
def gallery(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("gallery")
    save_human(folder / "Ada.human", person(), compact=True)
    return folder


@pytest.fixture(scope="module")
def archive(gallery, tmp_path_factory) -> Path:
    return build_addon.build(tmp_path_factory.mktemp("dist"), viewer=True, gallery=gallery)


def test_the_zip_is_small_whole_and_accepted(archive):
    assert archive.name.startswith("primdiffusion_viewer-")
    assert archive.stat().st_size < 10e6
    tool = build_addon.blender_extension_tool()
    assert tool is not None
    build_addon.validate(archive, tool)
    with zipfile.ZipFile(archive) as made:
        manifest, names = tomllib.loads(made.read("blender_manifest.toml").decode()), set(made.namelist())
    assert list(manifest["permissions"]) == ["files"]
    assert len(manifest["permissions"]["files"]) <= 64
    assert {"LICENSE", "gallery/Ada.human", "gallery/Sample.human", "bundled/primdiffusion/files/arrays.py"} <= names
    assert {
        "motion/data/poses.blend",
        "motion/data/walk.npz",
        "bundled/primdiffusion/formats/poses/built_in.json",
    } <= names
    assert not [name for name in names if name.endswith((".safetensors", ".txt"))]
    assert not [name for name in names if name.startswith(("ui/setup", "requirements"))]


def test_no_code_in_it_downloads_or_installs(archive):
    words = re.compile(r"\b(pip|ensurepip|urllib|urlopen|http|ssl|ftplib|wheel)\b", re.IGNORECASE)
    with zipfile.ZipFile(archive) as made:
        for name in made.namelist():
            if name.endswith(".py"):
                tree = ast.parse(text := made.read(name).decode())
                assert not words.search(re.sub(r"https?://", "", text)), name
                imported = {
                    alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names
                }
                assert not imported & {"requests", "venv", "site"}, name
                assert "sys.path" not in text, name


def test_a_human_too_large_for_the_gallery_is_rejected(gallery, tmp_path):
    save_human(tmp_path / "Big.human", person())
    with refused(build_addon.BuildError, "Big.human", "3 MB"):
        build_addon.viewer_contents(tmp_path)
    with refused(build_addon.BuildError, ".human"):
        build_addon.viewer_contents(gallery / "none")


@pytest.fixture(scope="module")
def used(archive, tmp_path_factory) -> tuple[dict, Path]:
    """What the viewer did in a Blender of its own without a backend, and the folder of its files."""
    folder = tmp_path_factory.mktemp("used")
    return report_of("installed_viewer.py", archive, folder, folder=folder, bare=True)[0], folder


def test_a_human_of_the_gallery_is_added_posed_and_reshaped_without_a_backend(used):
    report, _ = used
    assert report["module"] == "bl_ext.user_default.primdiffusion_viewer"
    assert (report["added"], report["name"], report["bones"]) == (["FINISHED"], "Ada", 24)
    assert min(report["moved"]) > 0.02
    assert report["volumes"] == 1024


def test_its_export_is_as_small_and_comes_back(used):
    report, folder = used
    assert (report["exported"], report["imported"], report["humans"]) == (["FINISHED"], ["FINISHED"], 2)
    assert report["bytes"] < build_addon.LARGEST_IN_GALLERY
    assert load_human(folder / "again.human").betas[0] == pytest.approx(2.0)


def test_generate_without_a_backend_says_in_one_sentence_what_to_do(used):
    report, _ = used
    assert report["generate"].removeprefix("Error: ").strip().rstrip(".").lower() == NOT_INSTALLED.lower()


def test_what_needs_a_backend_is_not_shown_and_says_so_when_a_script_asks(used):
    report, folder = used
    assert report["panels"] == ["human", "render"]
    said = [text.removeprefix("Error: ").strip().rstrip(".").lower() for text in report["rejected"]]
    assert said == [NOT_INSTALLED.lower()] * 2
    assert not (folder / "mesh.glb").exists()


@pytest.mark.slow
def test_generate_runs_in_the_backend_that_pip_installed(archive, tmp_path):
    program = Path(sys.executable).with_name("primdiffusion")
    report, _ = report_of("installed_viewer.py", archive, tmp_path, program, folder=tmp_path, bare=True)
    assert report["generated"] == [["FINISHED"], ["FINISHED"]]
    assert (report["provenance"], report["boxes"]) == ([7, 8], [1024, 1024])
    assert report["standing"] == [True, True]
