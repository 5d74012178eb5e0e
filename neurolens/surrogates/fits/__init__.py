"""Fits of surrogates: polynomials, networks, tests of what passes."""
