"""Foundations that every other package may import: errors, ray status, files, settings, progress."""
