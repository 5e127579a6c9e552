"""A person in Blender: armature, proxy mesh, volumes and their material, built from one human.npz."""
