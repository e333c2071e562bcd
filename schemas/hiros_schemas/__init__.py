"""The hiros_skeleton_msgs message definitions."""
