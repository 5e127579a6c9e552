"""Subcommands and requests: a function each, which gets a record of `formats.requests` or `options`, checked.

`serve` and the command line import these modules, which load torch, when the first request runs, so that the child
answers `hello`, and the command line --help, at once.
"""
