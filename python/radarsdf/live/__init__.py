"""Incremental mapping, scan by scan: :class:`LiveMap`."""
