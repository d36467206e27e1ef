"""Show scans in 3D, on a page for the browser."""
