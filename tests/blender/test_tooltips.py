"""Words in the interface: every label a title, every tooltip a sentence, every error with its reason."""

import functools
import inspect
import re
from collections.abc import Iterator

import bpy
import pytest
from shown_words import classes, labels, properties, rna, ways

pytestmark = pytest.mark.any_blender

_SMALL = frozenset(
    "a an and as at by for from in into it of on or over per px the to until with vs x".split()  # noqa: SIM905
)
_LONGEST = 160


def is_title(text: str) -> bool:
    words = [word for part in text.replace("glTF", "GLTF").split() for word in part.split("/")]
    first = bool(words) and not re.match(r"[a-z]", words[0])
    return first and all(not re.match(r"[a-z]", word) or word in _SMALL for word in words)


def test_every_label_is_there_and_a_title(addon):
    wrong = [f"{where}: {label!r}" for where, label in labels() if label and not is_title(label)]
    missing = [where for where, label in labels() if not label and "_OT_" in where and "." not in where]
    assert not wrong, "\n".join(wrong)
    assert not missing, "\n".join(missing)


def tooltips() -> Iterator[tuple[str, str]]:
    for cls in classes(bpy.types.Operator):
        if "INTERNAL" not in cls.bl_options:
            yield cls.__name__, rna(cls).description
    for where, prop in properties():
        if prop.type not in ("POINTER", "COLLECTION"):
            yield where, prop.description


def test_every_tooltip_is_a_sentence_without_a_full_stop(addon):
    wrong = []
    for where, text in tooltips():
        text = text.strip()
        if not text:
            wrong.append(f"{where} has none")
        elif not re.match(r"[A-Z0-9.\-]", text) or text.endswith(".") or "\n" in text:
            wrong.append(f"{where}: {text!r}")
        elif len(text) > _LONGEST:
            wrong.append(f"{where} is {len(text)} characters long: {text!r}")
    assert not wrong, "\n".join(wrong)


def test_no_tooltip_repeats_its_label(addon):
    label_of = {where: prop.name.lower() for where, prop in properties()}
    assert not [where for where, text in tooltips() if text.strip().lower() == label_of.get(where)]


def test_each_thing_that_an_operator_does_has_its_own_tooltip(addon):
    several = 0
    for cls in classes(bpy.types.Operator):
        told = []
        differ = getattr(cls, "described_by", ()) or "description" in vars(cls)
        for given in ways(cls.bl_idname.partition(".")[2]) if differ else ():
            properties = bpy.context.window_manager.operator_properties_last(cls.bl_idname)
            for name, value in given.items():
                setattr(properties, name, value)
            told.append(cls.description(bpy.context, properties))
            for name in given:
                properties.property_unset(name)
        assert len(set(told)) == len(told), cls.__name__
        several += len(told) > 1
    assert several >= 5


def test_operators_that_are_greyed_out_say_why(addon):
    silent = []
    for cls in classes(bpy.types.Operator):
        operator = getattr(bpy.ops.primdiffusion, cls.bl_idname.partition(".")[2])
        if "INTERNAL" in cls.bl_options or operator.poll():
            continue
        with pytest.raises(RuntimeError) as error:
            operator()
        if "context is incorrect" in str(error.value):
            silent.append(cls.__name__)
    assert not silent, f"poll without poll_message_set: {silent}"


def test_no_operator_can_be_redone_with_a_slider_that_starts_the_backend(addon):
    source = functools.cache(inspect.getsource)

    def starts_it(cls: type) -> bool:
        ours = (one for one in cls.__mro__ if one.__module__.startswith("blender_primdiffusion"))
        return any(re.search(r"\bsubmit\(", source(one)) for one in ours)

    found = [cls for cls in classes(bpy.types.Operator) if starts_it(cls)]
    assert len(found) > 8
    for cls in found:
        assert not {"REGISTER", "UNDO"} & cls.bl_options, cls.__name__


@pytest.mark.parametrize("text", ["generate human", "Generate human", ""])
def test_the_audit_can_fail(text):
    assert not is_title(text)
    assert is_title("Vary a Human by X/Y")
