"""The engines that run the two networks: torch and ONNX Runtime."""
