"""The meshes of all that stands and moves in a street, one function for each kind of body."""
