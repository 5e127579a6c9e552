"""Textured triangles as pictures: z-buffers, textures at several sizes, orthographic views."""
