"""Derivatives, and both inverse maps."""
