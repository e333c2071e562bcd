"""The published systems, each a table of stages."""
