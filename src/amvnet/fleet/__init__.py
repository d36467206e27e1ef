"""Label millions of scans from object storage on a Ray cluster; needs the extra `fleet`."""
