"""What a log says about its cameras: their poses and their noise."""
