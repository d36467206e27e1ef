"""Labels that may be wrong, the most doubtful first."""
