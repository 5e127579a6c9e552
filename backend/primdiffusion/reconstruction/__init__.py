"""Humans from views (`from_captures`), by encoder or prior (`prior_fit`), and from plain pictures (`from_pictures`).

The posture of a human in pictures: its start and its file (`posture_start`), its refinement (`posture_fit`).
"""
