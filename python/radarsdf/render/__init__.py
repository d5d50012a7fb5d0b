"""Pictures of meshes, views, grids and trajectories."""
