"""Meshes of vehicles and people; x is forward, and all stand on z = 0."""
