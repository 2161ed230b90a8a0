"""`cap4d bench`: speed against error, measured beside the machine's ceilings. `protocol` says how."""
