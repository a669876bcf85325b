"""The compact prior: a small siamese network for matching, trained by us, that ships as ONNX."""
