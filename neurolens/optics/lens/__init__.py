"""A lens as data: its prescription, glasses, stop, and first-order properties. No ray is traced here."""
