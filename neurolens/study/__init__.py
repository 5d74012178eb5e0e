"""What a model is worth: its errors, vignetting, images and time against exact tracing, and pages of them."""
