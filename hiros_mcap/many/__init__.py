"""Many logs: which there are, what is done with each, on which machines, and what came of it."""
