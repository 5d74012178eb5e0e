"""Models of many states: zoom and internal focus as one more input."""
