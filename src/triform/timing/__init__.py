"""How fast one robot's step is."""
