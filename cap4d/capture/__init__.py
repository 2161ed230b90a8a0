"""Images, mattes, cameras and rig parameters of a person on disk (the FlowFace layout)."""
