"""Light that does not form the image: ghosts, glare and stars."""
