"""The authors' checkpoints, read, checked and converted at the border (SPEC 1, 3, 6)."""
