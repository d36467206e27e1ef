"""Simulate LiDARs: what their pulses hit, and what they measure."""
