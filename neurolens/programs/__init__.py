"""The lens in other programs."""
