"""Avatars made elsewhere, as bundles of ours. Nothing in their files is executed."""
