"""Whole pictures: people among opaque things, before a background, in one of several views."""
