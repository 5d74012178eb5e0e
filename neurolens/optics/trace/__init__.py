"""Traces rays: one surface step, written once for tensors, arrays and graphs, and rays through whole lenses."""
