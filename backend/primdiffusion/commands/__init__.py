"""A module a subcommand: its request as one frozen record, and the work that it asks for.

JSON-RPC (`serve`) reads a record's fields by `request.read_request`; the command line reads the same record by tyro.
Records import no torch: a child answers `hello`, and the command line --help, before it is loaded.
"""
