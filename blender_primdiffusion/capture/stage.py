"""The scene a capture is rendered in: of its own, so that the user's stays as it is, and gone when the capture ends."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import bpy

from .belongings import Belongings
from .device import choose_device
from .settings import CaptureSettings
from .surfaces import OPAQUE, PART

_LAYERS = 256
"""Of transparent surfaces behind each other: hair is many cards deep."""


class StageError(RuntimeError):
    """A scene that cannot be lit or rendered."""


class Stage:
    """A scene with a camera, lights and Cycles' settings. Close it: nothing of it may stay in the file."""

    def __init__(self, context: bpy.types.Context, settings: CaptureSettings):
        self.belongings = Belongings()
        """What was made for the capture: use as a context around whatever makes more."""
        self.scratch = Path(tempfile.mkdtemp(prefix="primdiffusion_capture_", dir=bpy.app.tempdir or None))
        """For pictures between Cycles and us."""
        self._context = context
        try:
            with self.belongings:
                self.scene = bpy.data.scenes.new("PrimDiffusion Capture")
                self.camera = bpy.data.objects.new("Capture", bpy.data.cameras.new("Capture"))
                self.scene.collection.objects.link(self.camera)
                self.scene.camera = self.camera
                _light(self.scene, settings)
            _set_up_cycles(self.scene, settings)
            _set_up_passes(self.scene)
            self.device_note = choose_device(self.scene, settings.device)
        except BaseException:
            self.close()
            raise

    @contextlib.contextmanager
    def entered(self) -> Iterator[bpy.types.Context]:
        """Makes the scene the active one while the block lasts; what the block makes belongs to the stage."""
        window = self._context.window
        with contextlib.ExitStack() as stack:
            stack.enter_context(self.belongings)
            if window is None:
                layer = self.scene.view_layers[0]
                stack.enter_context(bpy.context.temp_override(scene=self.scene, view_layer=layer))
            else:
                before = window.scene
                window.scene = self.scene
                stack.callback(setattr, window, "scene", before)
            yield bpy.context

    def close(self) -> None:
        """Take everything out of the file again."""
        self.belongings.remove()
        shutil.rmtree(self.scratch, ignore_errors=True)


def _set_up_cycles(scene: bpy.types.Scene, settings: CaptureSettings) -> None:
    cycles, render = scene.cycles, scene.render
    render.engine = "CYCLES"
    render.film_transparent = True
    render.threads_mode, render.threads = ("FIXED", settings.threads) if settings.threads else ("AUTO", 1)
    render.resolution_percentage = 100
    render.use_persistent_data = True  # the views of a pose share one scene: only the camera moves
    render.use_compositing = render.use_sequencer = render.use_border = render.use_motion_blur = False
    cycles.use_adaptive_sampling = False
    cycles.use_denoising = settings.denoise and settings.light != "uniform"
    cycles.max_bounces = 0 if settings.light == "uniform" else 3
    cycles.transparent_max_bounces = _LAYERS
    cycles.caustics_reflective = cycles.caustics_refractive = False
    files = render.image_settings
    if bpy.app.version >= (5, 0):
        files.media_type = "MULTI_LAYER_IMAGE"
    files.file_format, files.color_depth, files.exr_codec = "OPEN_EXR_MULTILAYER", "32", "NONE"


def _set_up_passes(scene: bpy.types.Scene) -> None:
    layer = scene.view_layers[0]
    layer.name = "Capture"
    layer.use_pass_z = layer.use_pass_normal = True
    layer.pass_alpha_threshold = OPAQUE
    part = layer.aovs.add()
    part.name, part.type = PART, "VALUE"


def _light(scene: bpy.types.Scene, settings: CaptureSettings) -> None:
    world = scene.world = bpy.data.worlds.new("Capture")
    if world.node_tree is None:
        world.use_nodes = True
    background = next(node for node in world.node_tree.nodes if node.type == "BACKGROUND")
    grey = 1.0 if settings.light == "dome" else 0.0
    background.inputs["Color"].default_value = (grey, grey, grey, 1.0)
    if settings.light == "hdri":
        picture = world.node_tree.nodes.new("ShaderNodeTexEnvironment")
        try:
            picture.image = bpy.data.images.load(str(settings.hdri))
        except RuntimeError as error:
            raise StageError(f"the HDRI {settings.hdri} cannot be read: choose an .hdr or .exr picture") from error
        world.node_tree.links.new(picture.outputs["Color"], background.inputs["Color"])
