"""Blur of a lens for pictures that were rendered sharp, and kernels of bokeh."""
