"""Policy family of any network: two ONNX graphs, `encode` and `step`."""
