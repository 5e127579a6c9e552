"""Merged volumes and the density gain."""
