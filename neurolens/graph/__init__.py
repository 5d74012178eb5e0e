"""One representation of everything that is computed for rays, and what reads it: numpy, torch, ONNX, C, GLSL."""
