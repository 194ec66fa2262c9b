"""Bodies other than the built-in world: simulators and real robots."""
