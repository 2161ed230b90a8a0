"""Where expressions come from."""
