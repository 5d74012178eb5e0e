"""Lens files of other programs, each format read to its public definition; `any_format.read_any` takes them all."""
