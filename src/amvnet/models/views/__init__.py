"""Projections of scans, and the mapping of scores back to the points."""
