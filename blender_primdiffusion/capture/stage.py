"""The scene that a capture is rendered in: separate, so that the user's stays as it is, and removed afterwards."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path

import bpy

from ..files.regular_files import FileError, check_regular, remove_file, remove_folder
from ..formats.camera_rig import View
from .cameras import aim
from .passes import Centres, Colours, read_centres, read_colours
from .settings import CaptureSettings, Device
from .surfaces import OPAQUE, PART

_EXCLUDED = frozenset({"window_managers", "workspaces", "screens", "libraries"})


class AddedData:
    """Tracks the data-blocks that are added within `with` blocks; `remove` removes them, and no others."""

    def __init__(self) -> None:
        self._ours: set[int] = set()
        self._before: set[int] = set()

    def __enter__(self) -> AddedData:
        self._before = {block.session_uid for block in data_blocks()}
        return self

    def __exit__(self, *_: object) -> None:
        self._ours |= {block.session_uid for block in data_blocks()} - self._before

    def remove(self) -> None:
        """Remove those that are left."""
        bpy.data.batch_remove([block for block in data_blocks() if block.session_uid in self._ours])
        self._ours.clear()


def data_blocks() -> Iterator[bpy.types.ID]:
    """All data-blocks but windows, workspaces and libraries."""
    for prop in bpy.data.bl_rna.properties:
        if prop.type == "COLLECTION" and prop.identifier not in _EXCLUDED:
            yield from getattr(bpy.data, prop.identifier)


_KINDS = ("OPTIX", "CUDA", "HIP", "ONEAPI", "METAL")


def choose_device(scene: bpy.types.Scene, wanted: Device) -> str:
    """Set the scene's device, the CPU where no GPU can be used; returns a sentence on it.

    The preferences change only where no device was chosen before.
    """
    addon = bpy.context.preferences.addons.get("cycles")
    if wanted == "cpu" or addon is None:
        scene.cycles.device = "CPU"
        return "Cycles renders on the CPU."
    names = _gpus(addon.preferences)
    scene.cycles.device = "GPU" if names else "CPU"
    if names:
        return f"Cycles renders on {', '.join(names)}."
    return "No GPU can be used; Cycles renders on the CPU." if wanted == "gpu" else "Cycles renders on the CPU."


def _gpus(preferences: bpy.types.AddonPreferences) -> list[str]:
    chosen = preferences.compute_device_type
    kinds = (chosen,) if chosen != "NONE" else _KINDS
    for kind in kinds:
        try:
            preferences.compute_device_type = kind
        except TypeError:  # this Blender was built without it
            continue
        preferences.refresh_devices()
        devices = [device for device in preferences.devices if device.type == kind]
        if chosen == "NONE":
            for device in devices:
                device.use = True
        if names := [device.name for device in devices if device.use]:
            return names
    preferences.compute_device_type = chosen
    return []


_LAYERS = 256
"""Transparent surfaces along a ray: hair has many layers."""


class CaptureScene:
    """A scene with a camera, lights and Cycles' settings; `close` removes all of it."""

    def __init__(self, context: bpy.types.Context, settings: CaptureSettings):
        self.added = AddedData()
        """Data added for the capture: use as a context around whatever adds more."""
        self.scratch = Path(tempfile.mkdtemp(prefix="primdiffusion_capture_", dir=bpy.app.tempdir or None))
        """Folder for rendered files."""
        self._context = context
        self._hdris, self._environment = settings.hdris if settings.light == "hdri" else (), None
        try:
            with self.added:
                self.scene = bpy.data.scenes.new("PrimDiffusion Capture")
                self.camera = bpy.data.objects.new("Capture", bpy.data.cameras.new("Capture"))
                self.scene.collection.objects.link(self.camera)
                self.scene.camera = self.camera
                self._environment = _light(self.scene, settings)
            _set_up_cycles(self.scene, settings)
            _set_up_passes(self.scene, settings)
            self.device_note = choose_device(self.scene, settings.device)
        except BaseException:
            self.close()
            raise

    @contextlib.contextmanager
    def entered(self) -> Iterator[bpy.types.Context]:
        """Make the scene active for the block; data added in the block is removed with the stage."""
        window = self._context.window
        with contextlib.ExitStack() as stack:
            stack.enter_context(self.added)
            if window is None:
                layer = self.scene.view_layers[0]
                stack.enter_context(bpy.context.temp_override(scene=self.scene, view_layer=layer))
            else:
                before = window.scene
                window.scene = self.scene
                stack.callback(setattr, window, "scene", before)
            yield bpy.context

    def choose_hdri(self, seed: int) -> None:
        """Light by the picture that a view's seed chooses of a folder. Raises FileError."""
        if len(self._hdris) > 1 and self._environment is not None:
            before, path = self._environment.image, self._hdris[seed % len(self._hdris)]
            if before.filepath == str(path):
                return
            with self.added:
                self._environment.image = _load_hdri(path)
            bpy.data.images.remove(before)

    def close(self) -> None:
        """Remove everything from the file."""
        self.added.remove()
        remove_folder(self.scratch, self.scratch.parent)


def _set_up_cycles(scene: bpy.types.Scene, settings: CaptureSettings) -> None:
    cycles, render = scene.cycles, scene.render
    render.engine = "CYCLES"
    render.film_transparent = True
    render.threads_mode, render.threads = ("FIXED", settings.threads) if settings.threads else ("AUTO", 1)
    render.resolution_percentage = 100
    render.use_persistent_data = True  # only the camera moves between the views of a pose
    render.use_compositing = render.use_sequencer = render.use_border = render.use_motion_blur = False
    cycles.use_adaptive_sampling = False
    cycles.use_denoising = settings.denoise and settings.light != "uniform"
    cycles.max_bounces = 0 if settings.light == "uniform" else 3
    cycles.transparent_max_bounces = _LAYERS
    cycles.caustics_reflective = cycles.caustics_refractive = False
    files = render.image_settings
    files.media_type = "MULTI_LAYER_IMAGE"
    files.file_format, files.color_depth, files.exr_codec = "OPEN_EXR_MULTILAYER", "32", "NONE"


def _set_up_passes(scene: bpy.types.Scene, settings: CaptureSettings) -> None:
    layer = scene.view_layers[0]
    layer.use_pass_environment = settings.background == "hdri"
    layer.name = "Capture"
    layer.use_pass_z = layer.use_pass_normal = True
    layer.pass_alpha_threshold = OPAQUE
    part = layer.aovs.add()
    part.name, part.type = PART, "VALUE"


def _light(scene: bpy.types.Scene, settings: CaptureSettings) -> bpy.types.ShaderNodeTexEnvironment | None:
    """Light the scene; returns the node with the HDRI, if there is one."""
    world = scene.world = bpy.data.worlds.new("Capture")
    background = next(node for node in world.node_tree.nodes if node.type == "BACKGROUND")
    grey = 1.0 if settings.light == "dome" else 0.0
    background.inputs["Color"].default_value = (grey, grey, grey, 1.0)
    if settings.light != "hdri":
        return None
    picture = world.node_tree.nodes.new("ShaderNodeTexEnvironment")
    picture.image = _load_hdri(settings.hdris[0])
    world.node_tree.links.new(picture.outputs["Color"], background.inputs["Color"])
    return picture


def _load_hdri(path: Path) -> bpy.types.Image:
    try:
        check_regular(str(path))  # Blender would wait for a pipe
        return bpy.data.images.load(str(path))
    except (RuntimeError, OSError) as error:
        raise FileError(path, "cannot be read as an HDRI", "choose an .hdr or .exr picture") from error


_NARROWEST_PX = 0.01
"""Cycles' narrowest filter: rays within 0.02 px of the pixel's centre."""


def shoot_colours(stage: CaptureScene, view: View, seed: int, samples: int) -> Colours:
    """Colours and coverage, averaged over each pixel by a box of its size. Raises RuntimeError."""
    cycles = stage.scene.cycles
    cycles.pixel_filter_type, cycles.samples = "BOX", samples
    return read_colours(_render(stage, view, seed))


def shoot_centres(stage: CaptureScene, view: View, seed: int) -> Centres:
    """What the rays through the pixels' centres hit. Raises RuntimeError."""
    cycles = stage.scene.cycles
    denoise, cycles.use_denoising = cycles.use_denoising, False
    cycles.pixel_filter_type, cycles.filter_width, cycles.samples = "GAUSSIAN", _NARROWEST_PX, 1
    try:
        return read_centres(_render(stage, view, seed))
    finally:
        cycles.use_denoising = denoise


def _render(stage: CaptureScene, view: View, seed: int) -> Path:
    scene, render, path = stage.scene, stage.scene.render, stage.scratch / "view.exr"
    render.resolution_x, render.resolution_y = view.width, view.height
    render.pixel_aspect_x, render.pixel_aspect_y = aim(stage.camera, view)
    scene.cycles.seed = seed
    remove_file(path, path.parent)
    try:
        with stage.added:  # the first render makes the image Render Result
            bpy.ops.render.render(scene=scene.name)
        render.pixel_aspect_x = render.pixel_aspect_y = 1.0  # 5.0 cannot write layers with non-square pixels
        result = next(image for image in bpy.data.images if image.type == "RENDER_RESULT")
        result.save_render(str(path), scene=scene)
    except RuntimeError as error:
        raise RuntimeError(f"Cycles could not render: {' '.join(str(error).split())}") from error
    if not path.is_file():
        raise RuntimeError(f"Cycles wrote no picture to {stage.scratch}: is there room, and is the folder writable?")
    return path
