"""The viewer in the browser: the surface, the scans, and a sensor to drag. It needs the extra `view`."""
