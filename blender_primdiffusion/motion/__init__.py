"""Poses and motion from files, as joint rotations."""
