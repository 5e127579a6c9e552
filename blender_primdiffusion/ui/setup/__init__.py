"""Preferences, and the backend's private environment: set up, repaired, removed, tested."""
