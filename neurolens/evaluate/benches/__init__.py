"""Benchmarks: what `neurolens bench` measures and writes."""
