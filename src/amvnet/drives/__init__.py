"""Drives: consecutive scans of one recording with their poses, whose scores are fused over time."""
