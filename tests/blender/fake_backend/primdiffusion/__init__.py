"""Stands in for the backend: speaks its protocol, hands out a prepared human.npz, misbehaves for some seeds."""

__version__ = "0-fake"
