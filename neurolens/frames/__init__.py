"""One picture, or the frames of an animation, with their flare and files, rendered here or on a farm."""
