"""Surrogates: ray domain and pairs, terms, fits, networks, cards and ONNX files."""
