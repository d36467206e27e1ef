"""Datasets: those of both benchmarks, simulated streets, and a user's own scans."""
