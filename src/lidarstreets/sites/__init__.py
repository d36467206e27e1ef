"""Fill streets with bodies: plots, open areas, boundaries, vehicles and people."""
