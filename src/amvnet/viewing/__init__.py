"""Scans in 3D: a page for the browser, or Rerun."""
