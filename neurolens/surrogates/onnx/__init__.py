"""Surrogates as ONNX graphs."""
