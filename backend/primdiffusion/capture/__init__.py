"""Pictures of textured meshes: the rasteriser, and what is measured on its pictures."""
