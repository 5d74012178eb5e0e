"""Sets a lens for a frame: zoom, focus, stop, image circle and rims; checks that a prescription makes sense."""
