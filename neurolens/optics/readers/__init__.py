"""Lens files of this project, and by public format definitions of others; `any_format.read_any` reads all of them."""
