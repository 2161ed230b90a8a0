"""The .cap4d file; FORMAT.md is its specification."""
