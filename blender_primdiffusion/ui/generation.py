"""The one generation that may run at a time, and what becomes of it in the scene."""

from __future__ import annotations

import shutil
import tempfile
import time
from pathlib import Path

import bpy

from ..places import new_backend, preference
from ..scene.human import build_human, overlap_warning
from ..scene.human_file import HumanFileError
from ..scene.volumes import VolumeWriteError
from ..worker.job import Backend, GenerateJob

TICK_S = 0.1


class Busy(RuntimeError):
    """A person is being generated already."""


class GenerationFailed(RuntimeError):
    """No person; the message is for the user."""


class Session:
    """Owns the child process and the running job. All methods are for Blender's main thread."""

    def __init__(self) -> None:
        self.job: GenerateJob | None = None
        """The job under way, None when idle."""
        self.error: str = ""
        """Why the last generation failed, in a sentence; empty when it went well."""
        self.notice: str = ""
        """How the last generation ended otherwise."""
        self.device = ""
        """What the backend computes on, once it has said so."""
        self.seconds: dict[str, float] = {}
        """Of the last generation: "generate" from the click to the backend's answer, "build" in the scene."""
        self._started = 0.0
        self._backend: Backend | None = None
        self._backend_python = ""
        self._folder: Path | None = None

    @property
    def busy(self) -> bool:
        """A generation is under way."""
        return self.job is not None

    def start(self, seed: int, steps: int) -> None:
        """Begin a generation. Raises Busy, or OSError when there is no folder to work in."""
        if self.busy:
            raise Busy("a person is being generated; wait for it or press Cancel")
        self.error = self.notice = ""
        self.seconds, self._started = {}, time.monotonic()
        self._folder = Path(tempfile.mkdtemp(prefix="generate_", dir=bpy.app.tempdir or None))
        checkpoint = preference("checkpoint")
        self.job = GenerateJob(
            self._backend_for(preference("backend_python")),
            seed=seed,
            steps=steps,
            out_dir=self._folder,
            checkpoint=Path(checkpoint) if checkpoint else None,
        )

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
            return self._build(context, job)
        except (GenerationFailed, HumanFileError, VolumeWriteError) as error:
            self.error = _sentence(error)
            raise GenerationFailed(self.error) from error
        except Exception as error:
            self.error = f"The person could not be built: {_sentence(error)}"
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

    def _build(self, context: bpy.types.Context, job: GenerateJob) -> bpy.types.Collection:
        began = time.monotonic()
        result = job.result or {}
        human_npz = Path(result["human"])
        keep = [Path(result["person"])] if "person" in result else []  # for the exact marcher, later
        collection = build_human(context, human_npz, "Human", keep)
        self.seconds = {"generate": began - self._started, "build": time.monotonic() - began}
        self.notice = overlap_warning(collection) or f"{job.message}, built in {self.seconds['build']:.1f} s"
        bpy.ops.ed.undo_push(message="Generate Human")
        return collection

    def _backend_for(self, python: str) -> Backend:
        """The child of this interpreter; changing the preference ends the former one."""
        if self._backend is not None and python == self._backend_python:
            return self._backend
        if self._backend is not None:
            self._backend.shutdown()
        self._backend, self._backend_python = new_backend(python), python
        return self._backend


def _sentence(error: BaseException) -> str:
    text = str(error).strip() or type(error).__name__
    text = text[:1].upper() + text[1:]
    return text if text.endswith(".") else f"{text}."


session = Session()
"""Blender has one main thread and one user: one session."""
