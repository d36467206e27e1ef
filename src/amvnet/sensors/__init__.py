"""LiDAR sensors: known ones, measured ones, and scans normalised to the weights."""
