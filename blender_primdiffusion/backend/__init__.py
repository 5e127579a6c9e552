"""The backend as seen from Blender: find its Python, run it as a child process, follow one request. Without bpy."""
