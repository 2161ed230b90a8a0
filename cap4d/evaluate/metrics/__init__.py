"""What pictures of an avatar are measured by, one metric a file."""
