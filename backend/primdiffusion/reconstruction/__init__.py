"""Humans from pictures: by the encoder or the prior (`from_captures`), and from plain ones (`from_pictures`).

How a human stands in them: where it starts from (`posture_start`), how it is refined (`posture_fit`), its file
(`posture_file`).
"""
