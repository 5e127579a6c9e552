"""Exports of a mesh that take a second: its surface is taken from a coarse grid."""

import functools

import pytest
from primdiffusion.export import proxy


def make_small(patch: pytest.MonkeyPatch) -> None:
    """Five times the default spacing, as no option of the command gives."""
    patch.setattr(proxy, "ProxySettings", functools.partial(proxy.ProxySettings, 0.03))
