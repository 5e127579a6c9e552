"""Humans in Blender: armature, body mesh, volumes and material, built from a human.npz; their files; mesh proxies."""
