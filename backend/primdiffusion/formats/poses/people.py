"""Whose poses are in a tracker's output: each person's arrays, which may be one level down, or divided by frames.

- GVHMR: `smpl_params_global`, beside the same in a camera's axes;
- WHAM, VIBE: a person's arrays by the person's number; `pose_world` and `trans_world` rather than a camera's;
- PHALP, 4D-Humans' track.py: frames by the picture's name, with the numbers of the people in it (`tid`) and their
  `smpl`, in a camera's axes;
- SAM 3D Body: a list of people.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ...files.regular_files import FileError
from ...files.smpl_pickle import Inert, as_array

WORLD = "smpl_params_global"
_NUMBERS, _PARAMETERS = "tid", "smpl"
MOST = 1000
"""People in a file."""


def people_in(content: Any, keys: Collection[str]) -> dict[str, Mapping[str, Any]]:
    """Arrays by their names of each person, by name; the only person of a file without a level above is called "".

    A person's arrays have one of the `keys`. Other content holds no person. Raises ValueError for frames that do not
    belong together.
    """
    if isinstance(content, list) and content and isinstance(content[0], Mapping):
        content = dict(enumerate(content)) if len(content) > 1 else content[0]
    if not isinstance(content, Mapping):
        return {}
    if any(key in content for key in keys):
        return {"": content}
    if WORLD in content:
        content = {WORLD: content[WORLD]}
    if content and all(isinstance(v, Mapping) and {_NUMBERS, _PARAMETERS} <= v.keys() for v in content.values()):
        return _of_frames(content)
    found = {
        _name(name): person
        for name, person in content.items()
        if isinstance(person, Mapping) and any(key in person for key in keys)
    }
    if len(found) > MOST:
        raise ValueError(f"it holds more than {MOST} people")
    return found


def choose(people: Mapping[str, Mapping[str, np.ndarray]], lengths: Mapping[str, int], name: str, path: Path) -> str:
    """The person called `name`, or who has the most frames where it is empty. Raises FileError."""
    if not name:
        return max(people, key=lambda person: lengths[person])
    if name not in people:
        raise FileError(path, f"has no person {name!r:.40}", f"choose one of {listed(lengths)}")
    return name


def listed(lengths: Mapping[str, int]) -> str:
    """Names and numbers of frames of the people with the most."""
    most = sorted(lengths, key=lambda person: -lengths[person])[:6]
    more = f" and {len(lengths) - len(most)} more" if len(lengths) > len(most) else ""
    return ", ".join(f"{name:.20} ({lengths[name]} frames)" for name in most) + more


def _of_frames(content: Mapping[Any, Any]) -> dict[str, Mapping[str, Any]]:
    """The arrays of the people in frames, those of a person over all frames in which the person is."""
    frames: dict[str, list[Mapping[str, Any]]] = {}
    for frame in content.values():
        numbers, parameters = frame[_NUMBERS], frame[_PARAMETERS]
        if not isinstance(numbers, list) or not isinstance(parameters, list) or len(numbers) != len(parameters):
            raise ValueError(f"a frame has other numbers of people in {_NUMBERS!r} than in {_PARAMETERS!r}")
        for number, own in zip(numbers, parameters, strict=True):
            if not isinstance(own, Mapping) or not {"global_orient", "body_pose"} <= own.keys():
                raise ValueError(f"a frame has no poses in {_PARAMETERS!r}")
            if len(frames) >= MOST and _name(number) not in frames:
                raise ValueError(f"it holds more than {MOST} people")
            frames.setdefault(_name(number), []).append(own)
    return {
        name: {
            key: np.stack([as_array(one[key]).reshape(-1, 3, 3) for one in own])
            for key in ("global_orient", "body_pose")
        }
        for name, own in frames.items()
    }


def _name(key: Any) -> str:
    text = str(as_array(key)) if isinstance(key, Inert) else str(key)
    return "".join(letter for letter in text[:40] if letter.isprintable())
