"""Read and write label files of the benchmarks, of other tools and of this package."""
