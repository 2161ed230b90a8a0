"""cap4d-view: the window, and the same frames without one. Installed as cap4d.app; never imports torch."""
