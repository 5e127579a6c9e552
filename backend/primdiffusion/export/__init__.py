"""Export humans as textured, skinned meshes, 3D Gaussians and voxel grids."""
