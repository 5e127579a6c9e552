"""The version of the package, below every module that states it in a file."""

__version__ = "0.1.0"
