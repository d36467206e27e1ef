"""Networks for other runtimes: ONNX and int8 graphs, and the cache of the engines."""
