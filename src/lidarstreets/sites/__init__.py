"""Streets filled with bodies: plots, open areas, boundaries, vehicles and people."""
