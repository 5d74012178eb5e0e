"""Moved to `base.settings`."""

from neurolens.base.settings import *  # noqa: F403
