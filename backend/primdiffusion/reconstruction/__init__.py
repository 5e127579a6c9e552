"""Humans from views (`from_captures`), by encoder or prior (`prior_fit`), and from plain pictures (`from_pictures`).

How a human stands in them: where it starts from (`posture_start`), how it is refined (`posture_fit`), its file
(`posture_file`).
"""
