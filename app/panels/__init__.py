"""The panels of the window, one a file. Each draws itself from a `Viewer` and changes nothing else."""
