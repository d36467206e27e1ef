"""LiDAR sensors: known ones, measured ones, and scans adapted to the weights."""
