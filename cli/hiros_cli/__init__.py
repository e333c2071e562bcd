"""The hiros command line."""
