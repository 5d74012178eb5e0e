"""The blur of a lens for pictures that were rendered sharp, and its kernels of bokeh."""
