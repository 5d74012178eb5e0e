"""Errors that users see: one line that names the file, the field, the value and what was expected."""

from __future__ import annotations

from pathlib import Path


class NeurolensError(Exception):
    """Base class of every error that neurolens raises on purpose."""


class InputError(NeurolensError, ValueError):
    """Bad input: a file, a field, a shape, a unit or a domain.

    Args:
        file: the file at fault, or a word for where the value came from ("--set", "argument").
        field: the place inside it, for example "surface 3, radius_mm".
        value: what was found there.
        expected: what should have been there.
    """

    def __init__(self, file: str | Path, field: str, value: object, expected: str) -> None:
        shown = value if isinstance(value, str) and value.startswith("(") else repr(value)
        super().__init__(f"{file}: {field}: got {shown}, expected {expected}")
        self.file, self.field, self.value, self.expected = str(file), field, value, expected


class ModelError(NeurolensError, ValueError):
    """An exported lens model that cannot be trusted: truncated, of another schema, for another lens, or not finite."""


class NeurolensWarning(UserWarning):
    """Something that works but that a user should know, such as a glass without dispersion data."""
