"""Files on disk under the limits of SECURITY.md: arrays, JSON, pictures, pickles, tensors; whole or not at all.

The extension imports this as `blender_primdiffusion.files`, in a Python without torch: apart from `tensor_file`,
`torch_file`, modules import only numpy, the standard library and each other.
"""
