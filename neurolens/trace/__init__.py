"""What a ray does at one surface, written once for tensors, arrays and graphs, and rays traced through whole lenses."""
