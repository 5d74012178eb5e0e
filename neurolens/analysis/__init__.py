"""What lens designers look at: spots, fans, colour, curvature, distortion, illumination, MTF, Seidel sums, PSF."""
