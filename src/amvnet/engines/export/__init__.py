"""Export the networks for ONNX Runtime: graphs in float32 and int8, and their cache."""
