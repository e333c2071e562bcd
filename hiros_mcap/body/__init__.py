"""Geometry of skeletons: symmetry, angles, rotations, transforms and limb lengths."""
