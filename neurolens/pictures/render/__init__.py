"""A compact Monte Carlo renderer: vectorised numpy wavefronts, spectral, OpenEXR out."""
