"""Jobs of Human from Picture: fit a human's pose, shape and camera to a picture, and make the human in it."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ..backend.requests import sentence
from ..capture.cameras import aim_at_picture, picture_view, pictures_of
from ..files.json_files import read_json
from ..files.regular_files import as_file_error
from ..formats.answers import FitPostureAnswer, ReconstructAnswer
from ..formats.camera_rig import View
from ..formats.poses.rotation import from_axis_angle
from ..motion.poses import check_posable, take_world_posture, world_posture
from ..scene.actions import posed_on
from ..scene.armature import keyframe_poses
from ..scene.blend_values import file_path
from ..scene.edit import check_shapeable, reshape
from ..scene.handles import check_no_handles
from ..scene.human import BODY, HumanTarget, humans
from ..scene.representation import parts_by_representation
from ..scene.shape import betas_of
from .generate import build_person
from .queue import PREVIEW_PX, Job, chosen_checkpoint
from .variations import PICTURE_PX, backs

POSTURE_FORMAT = "primdiffusion-posture"
"""As `reconstruction/posture_start.py` of the backend writes it."""


def on_own_body(person: bpy.types.Object) -> bool:
    """Whether a human stands on a body of the user's files, whose shape and skeleton the fit does not know."""
    return BODY in person


@dataclasses.dataclass(frozen=True)
class PictureTask:
    """Pictures of one person, the camera they belong to, and where the fit starts. Holds no Blender objects."""

    pictures: tuple[str, ...]
    mask: str
    """Path of the mask of a single picture; empty if it has alpha. Ignored for several pictures."""
    camera: int
    """Session uid."""
    cameras: Mapping[str, Any]
    """That of the first picture, as in cameras.json."""
    size: tuple[int, int]
    """Width and height of the first picture, pixels."""
    posed: Mapping[str, Any] | None = None
    """Poses, translations and betas of the human posed over the pictures; None to start from a standing one."""

    @classmethod
    def of(cls, context: bpy.types.Context, mask: str, person: bpy.types.Object | None) -> PictureTask:
        """The scene's camera with its pictures, and `person` as it is posed over them: over several, on frames 1, 2 and
        so on. Raises ValueError."""
        camera = context.scene.camera
        images = pictures_of(camera)
        if camera is None or not images:
            raise ValueError("the scene's camera has no picture: choose one first, with Choose Picture")
        view = picture_view(context, camera, images[0])
        posed = None
        if person is not None:
            if on_own_body(person):
                raise ValueError(
                    f"the human {person.name!r} is on a body of your own files: pose one of the default body"
                )
            check_posable(person)
            check_no_handles(person)
            several = posed_on(context, person, range(1, len(images) + 1))
            poses, translations = zip(*map(world_posture, [person] if len(images) == 1 else several), strict=True)
            posed = {
                "pose": [pose.ravel().tolist() for pose in poses],
                "translation": [translation.tolist() for translation in translations],
                "betas": np.asarray(betas_of(person)).tolist(),
            }
        about = {"K": view.intrinsics.tolist(), "R": view.rotation.tolist(), "T": view.translation.tolist()}
        paths = [file_path(image.filepath, image.library) for image in images]
        if None in paths:
            raise ValueError(f"the picture of camera {camera.name!r} is not a file on this computer: choose it again")
        size = (view.width, view.height)
        return cls(tuple(map(str, paths)), mask, camera.session_uid, {"camera0000": about}, size, posed)

    def params(self, folder: Path) -> dict[str, Any]:
        """Parameters that both requests have; writes their files into `folder`."""
        params: dict[str, Any] = {"pictures": list(self.pictures)}
        if self.mask and len(self.pictures) == 1:
            params["masks"] = [self.mask]
        if len(self.pictures) > 1:  # each has a camera of its own, which is found by the person's size in it
            if self.posed is not None:
                np.savez(folder / "start.npz", poses=np.array(self.posed["pose"]))
                params["pose"] = str(folder / "start.npz")
        elif self.posed is None:
            (folder / "cameras.json").write_text(json.dumps(self.cameras), encoding="utf-8")
            params["cameras"] = str(folder / "cameras.json")
        else:
            posture = {"format": POSTURE_FORMAT, **self.posed, "cameras": self.cameras}
            (folder / "start.json").write_text(json.dumps(posture), encoding="utf-8")
            params["pose"] = str(folder / "start.json")
        checkpoint = chosen_checkpoint()
        return {**params, **({"checkpoint": checkpoint} if checkpoint else {}), "out_dir": str(folder / "fitted")}

    def camera_now(self) -> bpy.types.Object | None:
        """The camera, if it is still there."""
        return next((obj for obj in bpy.data.objects if obj.session_uid == self.camera and obj.type == "CAMERA"), None)


@dataclasses.dataclass(frozen=True)
class Fitted:
    """The content of posture.json."""

    poses: NDArray[np.float64]
    """[n, 24, 3], axis-angle: one for each picture."""
    translation: NDArray[np.float64]
    """In the first one."""
    betas: NDArray[np.float64]
    view: View
    """The first picture's."""

    def take(self, person: bpy.types.Object) -> None:
        """Pose a human as in the first picture; poses of several are keyed on frames 1, 2 and so on."""
        if len(self.poses) > 1:
            person.matrix_world = Matrix.Identity(4)
            bpy.context.scene.frame_set(1)
            frames, places = np.arange(1.0, len(self.poses) + 1), np.zeros((len(self.poses), 3))
            keyframe_poses(person, frames, from_axis_angle(self.poses), places, "Pictures")
        take_world_posture(person, self.poses[0], self.translation)


def read_fitted(path: Path, size: tuple[int, int]) -> Fitted:
    """Read the posture of pictures, the first of `size`. Raises ValueError and OSError."""
    content = read_json(path)
    with as_file_error(path, "is not a fitted pose or is damaged", "fit again"):
        camera = content["cameras"]["camera0000"]
        k, r, t = (np.asarray(camera[name], np.float64) for name in ("K", "R", "T"))
        return Fitted(
            np.asarray(content["pose"], np.float64).reshape(-1, 24, 3),
            np.asarray(content["translation"][0], np.float64).reshape(3),
            np.asarray(content["betas"], np.float64),
            View(k.reshape(3, 3), r.reshape(3, 3), t.reshape(3), *size),
        )


def fit_of(result: FitPostureAnswer | ReconstructAnswer) -> str:
    """How well the body explains the picture; empty for other versions of the backend, which do not say."""
    return "" if result.fit is None else f" (fit {result.fit} %)"


@dataclasses.dataclass(frozen=True)
class FitPictureJob(Job):
    """Fit to Picture."""

    kind = "fit_picture"
    method = "fit_posture"
    undo = "Fit to Picture"

    task: PictureTask
    target: HumanTarget

    @property
    def label(self) -> str:
        return f"Fit to Picture: {self.target.name}"

    def params(self, folder: Path) -> dict[str, Any]:
        return self.task.params(folder)

    def finish(self, context: bpy.types.Context, result: FitPostureAnswer, _folder: Path) -> str:
        fitted, person = read_fitted(result.posture, self.task.size), self.target.found()
        check_shapeable(person)
        check_posable(person)
        check_no_handles(person)
        reshape(person, fitted.betas)
        fitted.take(person)
        if (camera := self.task.camera_now()) is not None:
            aim_at_picture(camera, fitted.view)
        notice = f"Fitted{fit_of(result)} in {result.seconds:.1f} s"
        return " ".join(map(sentence, [notice, *result.warnings]))


@dataclasses.dataclass(frozen=True)
class PictureJob(Job):
    """Human from Picture."""

    kind = "from_picture"
    method = "reconstruct"
    undo = "Human from Picture"

    task: PictureTask
    backs: int = 0
    """Number of humans to choose from instead, with other unseen sides."""
    posed_over: int = 0
    """Session uid of the human posed over the picture, which is hidden; 0 for none."""

    @property
    def label(self) -> str:
        return f"Human from {Path(self.task.pictures[0]).name}"

    def params(self, folder: Path) -> dict[str, Any]:
        choice = {"backs": self.backs, "size": PICTURE_PX} if self.backs else {"size": PREVIEW_PX}
        return {**self.task.params(folder), **choice}

    def finish(self, context: bpy.types.Context, result: ReconstructAnswer, _folder: Path) -> str:
        assert result.posture is not None
        fitted = read_fitted(result.posture, self.task.size)
        armature, notice = build_person(context, result, f"Made{fit_of(result)}")
        armature.matrix_world = Matrix.Identity(4)
        context.view_layer.update()
        fitted.take(armature)
        backs.fill(result.backs, "", armature.session_uid)
        camera = self.task.camera_now()
        if camera is not None:
            aim_at_picture(camera, fitted.view)
        if not self.posed_over:
            _stand_at_origin(context, armature, camera)
        for other in humans(context.scene):
            if other.session_uid == self.posed_over:
                for hidden in (other, *filter(None, parts_by_representation(other).values())):
                    hidden.hide_viewport = hidden.hide_render = True
        return notice


def _stand_at_origin(context: bpy.types.Context, armature: bpy.types.Object, camera: bpy.types.Object | None) -> None:
    """Move the human onto the floor, and the camera with it: one picture does not tell where the floor is."""
    context.view_layer.update()
    back = Matrix.Translation(-armature.matrix_world.translation)
    for moved in (armature, camera):
        if moved is not None:
            moved.matrix_world = back @ moved.matrix_world
