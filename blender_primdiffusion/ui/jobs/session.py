"""The one person in the making - generated, reconstructed, edited - and what becomes of them in the scene."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ...places import new_backend, preference
from ...scene.edited import replace_person
from ...scene.human import build_human, overlap_warning, person_file
from ...scene.human_file import HumanFileError
from ...scene.volumes import VolumeWriteError
from ...worker.job import Backend, EditJob, GenerateJob, PersonJob, ReconstructJob
from .target import Target

TICK_S = 0.1
_UNDO_NAMES = {
    "generate": "Generate Human",
    "reconstruct": "Human from Captures",
    "vary": "Vary Human",
    "interpolate": "Blend Humans",
    "inpaint": "Re-dress Region",
    "transfer": "Transfer Texture",
}


class Busy(RuntimeError):
    """A person is being made already."""


class GenerationFailed(RuntimeError):
    """No person; the message is for the user."""


class Session:
    """Owns the child process and the running job. All methods are for Blender's main thread."""

    def __init__(self) -> None:
        self.job: PersonJob | None = None
        """The job under way, None when idle."""
        self.error: str = ""
        """Why the last generation failed, in a sentence; empty when it went well."""
        self.notice: str = ""
        """How the last generation ended otherwise."""
        self.kind = ""
        """The child's method of the job under way, or of the last one: generate, reconstruct or an edit."""
        self.device = ""
        """What the backend computes on, once it has said so."""
        self.seconds: dict[str, float] = {}
        """Of the last generation: "generate" from the click to the backend's answer, "build" in the scene."""
        self._started = 0.0
        self._backend: Backend | None = None
        self._backend_python = ""
        self._folder: Path | None = None
        self._target: Target | None = None

    @property
    def busy(self) -> bool:
        """A person is being made."""
        return self.job is not None

    def start(self, seed: int, steps: int, sampler: str = "ddim", asked: Mapping[str, Any] | None = None) -> None:
        """Begin a generation; `asked` may hold attributes and guidance.

        Raises Busy, or OSError when there is no folder to work in.
        """
        backend, folder = self._begin("generate")
        checkpoint = _checkpoint("checkpoint")
        self.job = GenerateJob(
            backend, seed=seed, steps=steps, out_dir=folder, sampler=sampler, asked=asked, checkpoint=checkpoint
        )

    def start_edit(
        self,
        person: bpy.types.Collection,
        method: str,
        steps: int,
        asked: Mapping[str, Any],
    ) -> None:
        """Begin to edit `person` by a method of the child with these parameters.

        A region that is an array holds painted weights [V], and travels as a file.
        Raises Busy, ValueError for a person that cannot be edited, FileNotFoundError for one whose file is missing, and
        OSError when there is no folder to work in.
        """
        target, file = Target.of(person), person_file(person)
        backend, folder = self._begin(method)
        if isinstance(asked.get("region"), np.ndarray):
            np.savez(folder / "region.npz", weights=asked["region"])
            asked = {**asked, "region": {"weights": str(folder / "region.npz")}}
        self._target = target
        checkpoint = _checkpoint("checkpoint")
        self.job = EditJob(backend, method, file, asked, out_dir=folder, steps=steps, checkpoint=checkpoint)

    def start_reconstruction(self, capture: Path, subject: str, frame: int, views: int) -> None:
        """Begin to make a person of captures; an empty subject: the only one. Raises as `start` does."""
        backend, folder = self._begin("reconstruct")
        self.job = ReconstructJob(
            backend,
            capture=capture,
            subject=subject or None,
            frame=frame,
            views=views,
            out_dir=folder,
            checkpoint=_checkpoint("encoder"),
        )

    def _begin(self, kind: str) -> tuple[Backend, Path]:
        """The child for a job, and a new folder for its files; the last job's news are gone."""
        if self.busy:
            raise Busy("a person is being made; wait for it or press Cancel")
        self.error = self.notice = ""
        self.kind, self.seconds, self._started = kind, {}, time.monotonic()
        self._folder = Path(tempfile.mkdtemp(prefix=f"{kind}_", dir=bpy.app.tempdir or None))
        return self._backend_for(preference("backend_python")), self._folder

    def tick(self) -> bool:
        """Take in news of the job; True when something visible changed. When it has finished, see `finish`."""
        if self.job is None:
            return False
        changed = self.job.tick()
        self.device = self.job.info.get("device_name") or self.device
        return changed

    def finish(self, context: bpy.types.Context) -> bpy.types.Collection | None:
        """End the finished job: build its person as one undo step, or keep its error; None when it was cancelled.

        Raises GenerationFailed with the sentence that `error` also holds. The session is idle afterwards in any case.
        """
        job, folder = self.job, self._folder
        self.job = self._folder = None
        if job is None or not job.finished:
            raise RuntimeError("there is no finished job; call tick until job.finished")
        try:
            if job.state == "cancelled":
                self.notice = job.message or ""
                return None
            if job.state == "failed":
                raise GenerationFailed(str(job.error))
            return self._replace(context, job) if isinstance(job, EditJob) else self._build(context, job)
        except (GenerationFailed, HumanFileError, VolumeWriteError) as error:
            self.error = _sentence(error)
            raise GenerationFailed(self.error) from error
        except Exception as error:
            self.error = f"The person could not be put into the scene: {_sentence(error)}"
            raise
        finally:
            if folder is not None:
                shutil.rmtree(folder, ignore_errors=True)

    def cancel(self) -> None:
        """Ask the job to stop; it ends within a step of the sampler."""
        if self.job is not None:
            self.job.cancel()

    def close(self) -> None:
        """Drop the job and end the child: the extension is going, or another file is loaded."""
        self.job = None
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None
        if self._backend is not None:
            self._backend.shutdown()
            self._backend = None

    def _build(self, context: bpy.types.Context, job: PersonJob) -> bpy.types.Collection:
        began = time.monotonic()
        result = job.result or {}
        human_npz = Path(result["human"])
        keep = [Path(result["person"])] if "person" in result else []  # for the exact marcher, later
        collection = build_human(context, human_npz, "Human", keep)
        self.seconds = {"generate": began - self._started, "build": time.monotonic() - began}
        warnings = [_sentence(text) for text in (*result.get("warnings", ()), overlap_warning(collection)) if text]
        self.notice = " ".join(warnings) or f"{job.message}, built in {self.seconds['build']:.1f} s"
        bpy.ops.ed.undo_push(message=_UNDO_NAMES[job.method])
        return collection

    def _replace(self, context: bpy.types.Context, job: PersonJob) -> bpy.types.Collection:
        began = time.monotonic()
        result = job.result or {}
        try:
            person = self._target.found()
            _leave_edit_mode(context)
            done = replace_person(context, person, Path(result["human"]), Path(result["person"]))
        except (ValueError, OSError) as error:
            raise GenerationFailed(str(error)) from error
        self.seconds = {"generate": began - self._started, "build": time.monotonic() - began}
        warnings = (*result.get("warnings", ()), done.warning, overlap_warning(person))
        shape = ", the body's shape too" if done.reshaped else ""
        self.notice = " ".join(
            [
                f"{job.message}; {done.volumes} of {done.of} volumes of {person.name} changed{shape}.",
                *(_sentence(text) for text in warnings if text),
            ]
        )
        bpy.ops.ed.undo_push(message=_UNDO_NAMES[job.method])
        return person

    def _backend_for(self, python: str) -> Backend:
        """The child of this interpreter; changing the preference ends the former one."""
        if self._backend is not None and python == self._backend_python:
            return self._backend
        if self._backend is not None:
            self._backend.shutdown()
        self._backend, self._backend_python = new_backend(python), python
        return self._backend


def _checkpoint(name: str) -> Path | None:
    """The file of a preference; None: the one that comes with the extension."""
    path = preference(name)
    return Path(path) if path else None


def _leave_edit_mode(context: bpy.types.Context) -> None:
    """Undo steps made in an edit mode hold what is being edited alone, not the person."""
    if context.mode.startswith(("EDIT", "PARTICLE")):
        bpy.ops.object.mode_set(mode="OBJECT")


def _sentence(error: BaseException | str) -> str:
    text = str(error).strip() or type(error).__name__
    text = text[:1].upper() + text[1:]
    return text if text.endswith(".") else f"{text}."


session = Session()
"""Blender has one main thread and one user: one session."""
