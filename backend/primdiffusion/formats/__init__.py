"""Formats shared by both programs: joints, poses, captures, requests and answers.

The extension imports it as `blender_primdiffusion.formats`, in a Python without torch: modules import only numpy, the
standard library, each other and the same kind of modules in `primdiffusion.files`.
"""
