"""Project scans, and map scores back to the points."""
