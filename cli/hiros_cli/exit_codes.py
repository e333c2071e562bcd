"""Exit codes of all commands besides 0."""

from __future__ import annotations

DIFFERENT = 1
"""`check` has found a difference."""
BAD_INPUT = 2
LOSSES = 3
"""A damaged log was recovered, and something is lost."""
BUG = 70
"""A fault of hiros."""
