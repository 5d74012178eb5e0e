"""Light that does not form the image: ghosts between the surfaces of a lens."""
