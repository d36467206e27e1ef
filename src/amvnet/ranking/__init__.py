"""Which scans to look at next."""
