"""Head models: one HeadRig, its importers, its UV grid."""
