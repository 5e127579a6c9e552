"""Captures rendered by a Blender of their own."""
