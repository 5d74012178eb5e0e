"""Torch's threads, pinned: a fit on one thread gives the same bits anywhere, and does not crawl on a shared machine."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from neurolens.base.errors import InputError


@contextmanager
def pinned_threads(threads: int = 1) -> Iterator[None]:
    """Give torch this many threads inside the block, and what it had before after it.

    Raises:
        InputError: fewer than one.
    """
    if threads < 1:
        raise InputError("torch", "threads", threads, "at least 1")
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)
