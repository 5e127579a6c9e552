"""Install the zip as a user does and render a cube: `python engine_installed.py ZIP PYTHON PICTURE`."""

from __future__ import annotations

import sys

import bpy

MODULE = "bl_ext.user_default.primdiffusion"
archive, python, picture = sys.argv[1:]
bpy.ops.wm.read_homefile(use_factory_startup=True, use_empty=True)
bpy.ops.extensions.package_install_files(filepath=archive, repo="user_default", enable_on_install=True)
bpy.context.preferences.addons[MODULE].preferences.backend_python = python
scene = bpy.context.scene
scene.render.engine = "PRIMDIFFUSION"
scene.render.resolution_x = scene.render.resolution_y = 32
scene.render.film_transparent = True
scene.render.filepath = picture
scene.render.image_settings.color_mode = "RGBA"
bpy.ops.mesh.primitive_cube_add(size=1.0)
bpy.ops.object.camera_add(location=(0.0, -4.0, 0.0), rotation=(1.5708, 0.0, 0.0))
scene.camera = bpy.context.object
bpy.ops.render.render(write_still=True)
