"""Lenses held against measurements of photographs."""
