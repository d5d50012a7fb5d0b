"""Scaling of time and memory with the returns and the size of the scene: `python -m bench.growth`, on Linux."""
