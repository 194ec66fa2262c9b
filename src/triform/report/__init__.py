"""Result files, tables and pages."""
