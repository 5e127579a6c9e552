"""Read, validate and convert the authors' checkpoints (SPEC 1, 3, 6)."""
