"""A backend without requirements, for environments made of tiny wheels."""

__version__ = "0-tiny"
