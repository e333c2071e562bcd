"""Joint positions from files that are no logs: CSV, TRC and JSON."""
