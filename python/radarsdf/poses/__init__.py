"""Estimation and refinement of poses from returns."""
