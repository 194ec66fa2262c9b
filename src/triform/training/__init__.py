"""Learning: one loop, its presets and its logs."""
