"""The settings of a fit, and their file."""
