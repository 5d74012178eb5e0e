"""The worth of a model: its errors, vignetting, images and time against exact tracing, and pages that show them."""
