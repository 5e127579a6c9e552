"""What a .blend holds is read by one module, and what it rejects is what no human has."""

import ast
import dataclasses
import importlib
import json
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import bpy
import pytest
from blend_tampering import HOLDERS, PREFERENCES, SETTINGS
from shown_words import classes
from support.errors import refused

import blender_primdiffusion
from blender_primdiffusion.scene import blend_values
from blender_primdiffusion.scene.blend_values import (
    as_numbers,
    as_shown,
    file_path,
    setting_path,
    stored_choice,
    stored_flag,
    stored_image,
    stored_numbers,
    stored_record,
    stored_text,
)
from blender_primdiffusion.scene.human import MARK
from blender_primdiffusion.scene.merged import MergedState
from blender_primdiffusion.ui.advanced_panel import _MOST_FRAMES

pytestmark = pytest.mark.any_blender
ROOT = Path(blender_primdiffusion.__file__).parent
READER = Path(blend_values.__file__)
READERS = {name for name in vars(blend_values) if name.startswith("stored_")}
PREFIX = "primdiffusion_"
OF_SCANS = {"primdiffusion_part"}
"""An attribute of meshes that captures make and render at once."""
OF_FILES = ("capture/scan_files.py", "primdiffusion")
"""A key in a file that captures read."""
OPERATORS_OWN = {"scene/blend_values.py", "ui/export_panel.py", "ui/motion_panel.py", "ui/picture_panel.py"}
"""Modules that resolve paths: besides the reader, those whose operators are given one by the user or a script."""
PERSON = "primdiffusion_person"
"""A custom property."""
ODD = [7, 0.5, [0.5] * 3, {"a": {"b": 1}}, b"\xff\x00", ["a", "b"], "x" * (blend_values.LONGEST_TEXT + 1)]


@pytest.fixture
def holder(empty_scene):
    return bpy.data.collections.new("Anna")


def read_by(node: ast.AST) -> tuple[ast.AST | None, str]:
    """The expression for the name of what a node may read, and how: by a reader, with `in`, or otherwise."""
    if isinstance(node, ast.Call) and len(node.args) > 1 and getattr(node.func, "id", "") in READERS:
        return node.args[1], "reader"
    if isinstance(node, ast.Call) and node.args and getattr(node.func, "attr", "") in ("get", "pop", "setdefault"):
        return node.args[0], "otherwise"
    if isinstance(node, ast.Compare) and isinstance(node.ops[0], ast.In | ast.NotIn):
        return node.left, "in"
    if isinstance(node, ast.Subscript) and isinstance(node.ctx, ast.Load):
        return node.slice, "otherwise"
    return None, ""


def uses(tree: ast.AST, module: ModuleType) -> Iterator[tuple[str, str]]:
    """Custom properties of ours that a module reads, and how."""
    for node in ast.walk(tree):
        key, how = read_by(node)
        name = key.value if isinstance(key, ast.Constant) else vars(module).get(getattr(key, "id", ""))
        if isinstance(name, str) and f"{name}_".startswith(PREFIX) and name not in OF_SCANS:
            yield name, how


def found_uses() -> Iterator[tuple[str, str, str]]:
    """Of all modules: the file, the property, and how it is read."""
    for path in sorted(ROOT.rglob("*.py")):
        if path.name == "__main__.py" or "bundled" in path.parts or path == READER:
            continue
        dotted = ".".join(path.relative_to(ROOT.parent).with_suffix("").parts).removesuffix(".__init__")
        module = importlib.import_module(dotted)
        for name, how in uses(ast.parse(path.read_text(encoding="utf-8")), module):
            file = path.relative_to(ROOT).as_posix()
            if (file, name) != OF_FILES:
                yield file, name, how


@pytest.mark.usefixtures("addon")
def test_every_custom_property_is_read_by_the_reader_and_tried_by_the_tampering():
    found = list(found_uses())
    assert [(file, name) for file, name, how in found if how == "otherwise"] == []
    assert {name for _, name, _ in found} == set(HOLDERS)


@pytest.mark.usefixtures("addon")
def test_every_setting_and_preference_that_is_a_path_is_tried_by_the_tampering():
    def paths(rna: bpy.types.Struct) -> tuple[str, ...]:
        kinds = {prop.identifier: getattr(prop, "subtype", "") for prop in rna.properties}
        return tuple(name for name, kind in kinds.items() if kind in ("FILE_PATH", "DIR_PATH"))

    groups = {
        prop.identifier: paths(prop.fixed_type)
        for prop in bpy.types.Scene.bl_rna.properties
        if prop.type == "POINTER" and prop.identifier.startswith("primdiffusion")
    }
    assert {group: names for group, names in groups.items() if names} == SETTINGS
    (preferences,) = classes(bpy.types.AddonPreferences)
    assert set(paths(preferences.bl_rna)) == set(PREFERENCES)


def test_only_the_reader_and_operators_on_the_users_own_paths_resolve_paths():
    calls = re.compile(r"path\.abspath\(")
    found = {
        path.relative_to(ROOT).as_posix()
        for path in ROOT.rglob("*.py")
        if calls.search(path.read_text(encoding="utf-8").replace("os.path.abspath(", ""))
    }
    assert found == OPERATORS_OWN


def test_a_record_is_parsed_once_however_often_panels_draw(holder, monkeypatch):
    parsed = []
    monkeypatch.setattr(blend_values, "parse_json", lambda text: parsed.append(text) or json.loads(text))
    for text in (json.dumps({"seed": list(range(9_000))}), "{" * 60_000):
        holder[MARK] = text
        for _ in range(3):
            found = stored_record(holder, MARK)
            found["mine"] = 1
        assert parsed.pop() == text
        assert not parsed
        assert "mine" not in stored_record(holder, MARK)


def test_the_longest_merged_sequence_fits_into_a_text():
    state = MergedState(("0123456789abcdef",) * _MOST_FRAMES, 0.0012345678901234567, -1_048_574)
    assert len(json.dumps(dataclasses.asdict(state))) <= blend_values.LONGEST_TEXT


@pytest.mark.parametrize("value", ODD, ids=lambda value: type(value).__name__)
def test_a_value_of_another_type_counts_as_missing(holder, value):
    for read, missing in (
        (lambda: stored_text(holder, PERSON), None),
        (lambda: stored_image(holder, PERSON, 100), None),
        (lambda: stored_record(holder, PERSON), {}),
        (lambda: stored_numbers(holder, PERSON, 10), None),
        (lambda: stored_choice(holder, PERSON, ("A", "B")), "A"),
    ):
        holder[PERSON] = "a text"
        del holder[PERSON]
        assert read() == missing
        holder[PERSON] = value
        assert read() == missing
    if not isinstance(value, int):
        assert stored_flag(holder, PERSON, True) is True
        assert stored_flag(holder, PERSON, False) is False


def test_what_the_extension_stores_is_read(holder):
    for value, read in (
        ("B", lambda: stored_choice(holder, PERSON, ("A", "B"))),
        (False, lambda: stored_flag(holder, PERSON, True)),
        ([0.5] * 10, lambda: stored_numbers(holder, PERSON, 10)),
    ):
        holder.pop(PERSON, None)
        holder[PERSON] = value
        assert read() == value
    holder[MARK] = json.dumps({"a": [1]})
    assert stored_record(holder, MARK) == {"a": [1]}


def test_an_image_counts_where_it_holds_a_packed_file_that_is_not_too_large(holder):
    image = holder[PERSON] = bpy.data.images.new("x", 1, 1)
    assert stored_image(holder, PERSON, 100) is None
    image.pack(data=b"a human", data_len=7)
    assert stored_image(holder, PERSON, 7) == image
    assert stored_image(holder, PERSON, 6) is None


@pytest.mark.parametrize("path", ["", "//x.vdb", r"\\host\share\x.vdb", "x.vdb"])
def test_a_volume_in_a_file_never_saved_has_no_path_relative_to_it(empty_scene, path):
    assert file_path(path, None) is None


def test_folders_of_users_have_any_name(saved_scene, tmp_path):
    for name in ("写真\u3000年", "a\u00a0b", "a\u200db", "\udcff", "x y'\"%"):
        folder = tmp_path / name / "Anna"
        assert file_path(f"{folder}/x.vdb", None) == folder / "x.vdb"


@pytest.mark.parametrize("stored", ["captures", "../x", r"\\host\share", "https://host/x", "a\nb"])
def test_a_setting_that_is_no_whole_path_is_named_in_one_sentence(saved_scene, stored):
    with refused(ValueError, "Captures") as caught:
        setting_path(stored, "Captures")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300


def test_settings_may_be_relative_to_a_saved_file_or_absolute_or_empty(saved_scene, tmp_path):
    assert setting_path("//captures", "Captures") == str(tmp_path / "captures")
    assert setting_path(f"{tmp_path}/", "Captures") == f"{tmp_path}/"
    assert setting_path("", "Captures") == ""
    bpy.ops.wm.read_homefile(use_empty=True)
    with refused(ValueError, "//captures"):
        setting_path("//captures", "Captures")


@pytest.mark.parametrize("values", [[float("nan")] * 2, [1e300, 0.0], [True, False], ["1", "2"], [1], "12", None, {}])
def test_no_list_of_two_numbers(values):
    assert as_numbers(values, 2) is None


@pytest.mark.parametrize("value", ["x" * 10**6, "a\ud800\x1b[2J\n", {"a": 1}, [1], 10**400, None, 0.5])
def test_what_is_shown_is_one_short_printable_line(value):
    shown = as_shown(value)
    assert shown.isprintable()
    assert len(shown) <= 130
    assert shown.encode()
