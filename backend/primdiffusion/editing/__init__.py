"""Control without training: variants of a person, people between two, parts made anew, textures taken from others."""
