"""Geometrical optics: prescriptions, glass, exact tracing, first-order data, pupils. Imports only torch and numpy."""
