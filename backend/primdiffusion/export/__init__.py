"""People for other programs: a textured, skinned mesh and 3D Gaussians."""
