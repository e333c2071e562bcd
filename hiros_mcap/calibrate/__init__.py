"""The poses and the noise of a log's cameras."""
