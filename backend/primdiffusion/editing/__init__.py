"""Training-free edits: variants, interpolation, inpainting and transfer of regions."""
