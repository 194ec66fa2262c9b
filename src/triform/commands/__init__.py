"""Commands: one file for each, with its options; everything below knows no terminal."""
