"""Stands in for the backend: speaks its protocol and answers as declared in serve.py."""

__version__ = "0-fake"
