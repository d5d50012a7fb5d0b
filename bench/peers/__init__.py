"""Other methods of surface reconstruction, each run in its own process; see `interface`.

This module imports nothing, since Pythons too old for radarsdf import it, too.
"""
