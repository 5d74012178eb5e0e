"""Surrogates: ray domain and pairs, bases, fits, networks, cards and ONNX graphs."""
