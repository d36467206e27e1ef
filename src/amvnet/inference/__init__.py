"""From scans to labels: the segmenter, the late fusion and the commands' pipeline."""
