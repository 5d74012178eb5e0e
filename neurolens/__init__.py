"""neurolens: any lens prescription as a fast camera model with a measured error."""

__version__ = "0.1.0"
