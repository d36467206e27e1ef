"""What runs the two networks: torch or ONNX Runtime."""
