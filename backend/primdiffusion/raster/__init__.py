"""Rasterised triangles: the z-buffer, textured meshes, views for captures, UV charts."""
