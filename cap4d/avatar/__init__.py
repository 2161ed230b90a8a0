"""The 4D avatar while it is being fitted."""
