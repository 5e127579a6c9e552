"""Humans in Blender: armature, body mesh, volumes and material, built from a .human file; their files; mesh proxies."""
