"""Classes, datasets, and files of scans and labels."""
