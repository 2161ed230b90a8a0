"""A fitted avatar becomes a bundle."""
