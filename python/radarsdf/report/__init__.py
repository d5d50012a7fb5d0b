"""One page about a map, for the browser. It needs the extras `plot` and `view`."""
