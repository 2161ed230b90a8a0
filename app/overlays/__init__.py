"""Overlays: what the picture is made of, drawn over it."""
