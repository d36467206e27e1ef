"""Labels of scans in files: those of the benchmarks, of other tools and of this package."""
