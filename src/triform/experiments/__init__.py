"""Experiments: many runs, measured, with tables, figures and pages."""
