"""Label scans: the segmenter, the late fusion, and the pipeline of the commands."""
