"""Multi-view captures of textured humans: rendering, reading, packing, training samples."""
