"""Weights files, the hub and model cards."""
