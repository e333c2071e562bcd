"""What people look at: pages with plots, and the Rerun viewer. Heavy imports wait for their use."""
