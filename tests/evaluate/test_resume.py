"""A training that is killed: the next run of the same command goes on, to the very same weights."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from lens_models import prepared

from neurolens.evaluate.measure import fit_and_measure
from neurolens.surrogates.cores import Network
from neurolens.surrogates.fit import ModelSettings, fit_model
from neurolens.surrogates.stored import load_fitted

SETTINGS = ModelSettings("mlp", units=10, layers=2, steps=40)
RUN = """
import sys
from pathlib import Path
sys.path[:0] = sys.argv[2:]
from lens_models import prepared
from neurolens.evaluate.measure import fit_and_measure
from neurolens.surrogates.fits import checkpoint
from test_resume import SETTINGS
checkpoint.EVERY_S = 0.0
fit_and_measure(prepared(), SETTINGS, Path(sys.argv[1]), 2000, lambda share: None)
"""


def _weights(core: object) -> torch.Tensor:
    assert isinstance(core, Network)
    return torch.cat([torch.from_numpy(t).reshape(-1) for pair in (*core.hidden, core.output) for t in pair])


@pytest.mark.slow
def test_a_killed_process_is_taken_up_again(tmp_path: Path) -> None:
    here = Path(__file__).parent
    process = subprocess.Popen([sys.executable, "-c", RUN, str(tmp_path), str(here.parent), str(here)])
    file = tmp_path / f"{SETTINGS.label}.training.npz"
    deadline = time.monotonic() + 120
    while not file.exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    process.kill()
    process.wait()
    assert file.exists(), "the training ended, or never began, before it could be killed"
    with np.load(file) as left:
        assert b'"ended": false' in left["header"].tobytes()
    whole = _weights(fit_model(prepared(), SETTINGS).core)
    made = fit_and_measure(prepared(), SETTINGS, tmp_path, 2000, lambda share: None)
    assert not file.exists()
    assert torch.equal(_weights(load_fitted(made.file).core).float(), whole.float())
