"""Recorded runs: formats, resampling, measures."""
