"""Quantities computed from the returns before training: rays, noise, surfels, ghosts, support, gaps."""
