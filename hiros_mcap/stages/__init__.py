"""One step of a system per module: its Params, one generator, private helpers."""
