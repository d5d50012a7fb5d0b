"""Fields of signed distance and intensity, on a grid or neural, and autograd functions over the core."""
