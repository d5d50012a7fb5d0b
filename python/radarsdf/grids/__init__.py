"""Grids for planners: occupied, free and unknown voxels, distances, costmaps, and their files."""
