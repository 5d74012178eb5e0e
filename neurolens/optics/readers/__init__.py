"""Readers of lens files: this project's own, and by public definitions those of others. `read_any` reads all."""
