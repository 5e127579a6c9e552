"""Formats shared by both programs: joints, arrays, captures, defaults of requests.

The extension imports it as `blender_primdiffusion.formats`, in a Python without torch: modules import only numpy, the
standard library and each other.
"""
