"""A person on disk: images, mattes, cameras and rig parameters."""
