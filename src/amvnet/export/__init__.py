"""Networks for other runtimes: ONNX, int8 and engines."""
