"""Rank labels that may be wrong, the most doubtful first."""
