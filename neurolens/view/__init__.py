"""One static page in which lenses and their models run: GLSL of the graph in a path tracer of WebGPU or WebGL2."""
