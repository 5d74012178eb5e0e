"""Small foundations that everything may import: errors, ray status, files, settings, progress."""
