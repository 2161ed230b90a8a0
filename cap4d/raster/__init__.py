"""Differentiable splatting behind one call."""
