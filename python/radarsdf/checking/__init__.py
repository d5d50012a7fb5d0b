"""Mistakes in scans and poses that are detectable before a fit."""
