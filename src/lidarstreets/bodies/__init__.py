"""Make the meshes of all that stands and moves in a street: one function for each kind of body.

The functions draw a body by the generator `rng`. Bodies stand on z = 0; lengths are in metres.
"""
