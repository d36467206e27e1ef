"""Make meshes of vehicles and people. They face +x and stand on z = 0; lengths are in metres."""
