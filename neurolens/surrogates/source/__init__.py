"""Surrogates as programs, and as C and GLSL."""
