"""The benchmarks: readers, label tables, catalogue, augmentation."""
