"""Adaptation to scans without labels: what two views agree on teaches both."""
