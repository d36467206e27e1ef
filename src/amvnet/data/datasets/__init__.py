"""The benchmarks' datasets, read in their official layouts."""
