"""How surrogates are fitted: polynomials, networks, tests of what passes."""
