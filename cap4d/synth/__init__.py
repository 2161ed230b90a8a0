"""Synthetic captures of a rig."""
