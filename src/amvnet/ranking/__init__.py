"""Which scans to look at next: those whose labels look wrong."""
