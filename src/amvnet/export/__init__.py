"""Export the networks for other runtimes: ONNX and int8 graphs, and their cache."""
