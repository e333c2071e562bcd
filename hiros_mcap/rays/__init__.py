"""RGB cameras: the keypoints of their images as rays, and what follows from them in space."""
