"""Stage 1: one network for all subjects that maps multi-view images of a human to primitives."""
