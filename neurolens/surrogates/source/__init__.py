"""Surrogates, and the exact lens, as C and GLSL."""
