"""A task for processes and clusters, in a module that is soon imported there."""

import os
import signal
import time
from pathlib import Path

from neurolens.base.errors import InputError
from neurolens.base.tasks import Shared


def count(common: Shared, task: tuple[int, str]) -> bytes:
    """The number, unless the task says what to do the first time."""
    number, deed = task
    if deed == "refuse":
        raise InputError("lens.toml", "radius_mm", number, "a radius")
    if deed == "break":
        raise ZeroDivisionError("oh")
    if deed == "exit":
        os._exit(3)
    if deed == "sleep":
        time.sleep(600)
    if deed == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    if deed and not Path(deed).exists():
        Path(deed).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return common.data + str(number).encode()
