"""Lens files of other programs, each read by its public format definition; `any_format.read_any` reads all of them."""
