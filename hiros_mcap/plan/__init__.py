"""Where to put cameras in a room, and how large the error of the result will be."""
