"""Blender: the extension (`extension/`, which Blender's own Python runs) and what packs it."""
