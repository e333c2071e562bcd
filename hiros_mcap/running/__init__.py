"""A run: from a log through a system to a log."""
