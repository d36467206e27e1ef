"""Rank labels that may be wrong, the most doubtful labels first."""
