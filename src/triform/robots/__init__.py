"""Real robots, their drivers and their emulators."""
