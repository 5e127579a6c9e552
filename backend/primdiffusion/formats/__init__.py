"""What both programs read and write: joints, arrays, captures, defaults of requests.

The backend imports it as `primdiffusion.formats`, the extension as `blender_primdiffusion.formats`, in whose Python
there is no torch: numpy and the standard library only, and nothing else of this package.
"""
