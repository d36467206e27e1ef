"""Millions of scans from object storage, labelled on Ray; needs the extra `fleet`."""
