"""The ground of streets: kinds of streets, their plans, the relief, and the surface."""
