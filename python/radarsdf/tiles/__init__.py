"""Maps larger than one machine's memory: a plan, a fit per tile, and one map over all tiles."""
