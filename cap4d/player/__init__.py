"""A bundle and an expression frame in, posed Gaussians and pictures out. NumPy, onnxruntime and _core."""
