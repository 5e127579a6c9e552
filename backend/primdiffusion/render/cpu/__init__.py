"""The marcher on processors, compiled by numba."""
