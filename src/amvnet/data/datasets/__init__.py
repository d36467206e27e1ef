"""Both benchmarks, simulated streets, and a user's own scans as datasets."""
