"""Analyses of a lens: spots, fans, colour, curvature, distortion, illumination, MTF, Seidel sums, PSF."""
