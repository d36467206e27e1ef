"""Describe and measure LiDAR sensors, and normalise their scans for the weights."""
