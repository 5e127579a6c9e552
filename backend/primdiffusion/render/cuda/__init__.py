"""The marcher on NVIDIA GPUs, compiled by Triton."""
