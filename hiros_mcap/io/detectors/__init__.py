"""Readers of what detectors publish, one sibling per kind; :mod:`.detector` is their interface."""
