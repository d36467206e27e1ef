"""Training of the two networks and the point head."""
