"""`python -m primdiffusion.people --assets DIR --count N --variants M --seed S --out DIR`."""

import sys

import tyro

from primdiffusion.people.assets import AssetsMissingError
from primdiffusion.people.command import PeopleCommand, run
from primdiffusion.people.mhclo import ProxyFileError

if __name__ == "__main__":
    try:
        run(tyro.cli(PeopleCommand, prog="primdiffusion people"))
    except (AssetsMissingError, ProxyFileError, ValueError) as error:
        sys.exit(str(error))
