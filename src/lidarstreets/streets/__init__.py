"""Draw the ground of streets: the kind of a street, its plan, its relief and its surface."""
