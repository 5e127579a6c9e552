"""Generate dressed, rigged humans from MakeHuman assets: the training data."""
