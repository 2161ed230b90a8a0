"""Photos and video in, a capture out."""
