"""Fitting of a map to scans with poses: the steps of a fit, the averaged and the trained surface, and estimates of its cost."""
