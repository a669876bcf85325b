"""Two-view networks in torch, as they are trained and exported; tracking runs their ONNX files."""
