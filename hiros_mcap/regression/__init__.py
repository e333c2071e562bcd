"""Golden logs: does hiros still give what it gave, and is it still good enough."""
