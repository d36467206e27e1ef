"""Readers of single scans and bags in many file formats."""
