"""Arithmetic on rays as programs of float steps: their derivatives, C from them, and compiling that."""
