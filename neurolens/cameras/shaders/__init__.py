"""Cameras as shaders of Open Shading Language, and as source code for other integrators."""
