"""Projections of a scan, and the way of the scores back to its points."""
