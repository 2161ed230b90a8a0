"""Makes an avatar's file smaller and its frames faster, to a stated error of its pictures. Needs torch."""
