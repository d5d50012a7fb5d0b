"""Scenes of tests and benchmarks, and changes of settings by name."""
