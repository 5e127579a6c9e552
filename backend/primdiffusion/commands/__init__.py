"""Subcommands: each is a request, a frozen record with a method that runs it.

JSON-RPC (`serve`) reads the record with `request.read_request`, the command line with tyro. Modules of records import
torch only when a request runs, so that the child answers `hello`, and the command line --help, at once.
"""
