"""Archives for the benchmarks' servers."""
