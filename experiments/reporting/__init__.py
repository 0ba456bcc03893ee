"""Results read from their files, and shown: tables, plots, pictures and pages."""
