"""Changes between two maps of one place: surface that appeared, disappeared or moved, and changed reflectance."""
