"""The fitted map: queries, meshes, and storage in a file."""
