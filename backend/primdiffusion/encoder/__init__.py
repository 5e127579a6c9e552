"""Stage 1: pictures of a person from several sides -> the person's primitives, by one network for everybody."""
