"""Dressed, rigged people as glTF: `primdiffusion people`."""

from __future__ import annotations

from collections.abc import Sequence

import tyro

from primdiffusion.people.command import PeopleCommand, run_people


def run(arguments: Sequence[str]) -> None:
    """One command line, errors as exceptions."""
    run_people(tyro.cli(PeopleCommand, args=arguments, prog="primdiffusion people"))
