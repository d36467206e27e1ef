"""Write archives of predictions for the benchmarks' servers."""
