"""Multi-view captures of people, rendered in Cycles."""
