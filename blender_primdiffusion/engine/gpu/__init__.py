"""Humans on the GPU that shows Blender's windows: the marcher, its pictures, and how they are drawn into 3D views."""
