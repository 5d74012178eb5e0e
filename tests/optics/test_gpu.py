"""The tracer on an accelerator: the same results there, and no wait for the device within the loop over surfaces.

Without an accelerator the second is still checked by torch's meta device, whose tensors have no values: whoever asks
for one, for a decision of the host, raises.
"""

from __future__ import annotations

import pytest
import torch
from shipped import focused

from experiments.extreme_cases import from_film, generator
from neurolens.optics.prescription import Lens
from neurolens.optics.trace import CHUNK, Rays, Traced, trace

NAMES = ["laikin_double_gauss_50", "canon_aspheric_50", "schneider_anamorphic_31", "shimizu_fisheye_220"]
needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here: nothing was run on one")


def bundle(lens: Lens, count: int, dtype: torch.dtype) -> tuple[Rays, torch.Tensor]:
    rays = from_film(lens, count, generator())
    return Rays(*(c.to(dtype) for c in rays)), torch.linspace(400, 700, count, dtype=dtype)


def on(device: str, rays: Rays, wavelength_nm: torch.Tensor) -> tuple[Rays, torch.Tensor]:
    return Rays(*(c.to(device) for c in rays)), wavelength_nm.to(device)


def tensors(out: Traced) -> list[torch.Tensor]:
    crossings = [c for crossing in out.crossings.values() for c in crossing]
    return [*out.rays, out.status, *([] if out.transmittance is None else [out.transmittance]), *crossings]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("options", [{}, {"transmittance": True}, {"transmittance": "polarised"}, {"record": [0, 3]}])
def test_the_host_decides_nothing(name: str, options: dict[str, object]) -> None:
    """Rays without values go through the whole lens, in one chunk and in several."""
    lens = focused(name)
    for count in (100, CHUNK + 100):
        start = on("meta", *bundle(lens, count, torch.float32))
        out = trace(lens, *start, **options)  # type: ignore[arg-type]
        assert {t.device.type for t in tensors(out)} == {"meta"}
        assert all(t.shape == (count,) for t in tensors(out))


@needs_cuda
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", NAMES)
def test_the_same_results_on_cuda(name: str, dtype: torch.dtype) -> None:
    lens = focused(name)
    start = bundle(lens, 20000, dtype)
    here = trace(lens, *start, transmittance=True)
    there = trace(lens, *on("cuda", *start), transmittance=True)
    status = there.status.cpu()
    assert int((status != here.status).sum()) <= (20 if dtype == torch.float32 else 0)
    passed = (status == 0) & (here.status == 0)
    assert passed.sum() > 1000
    for a, b in zip(there.rays, here.rays, strict=True):
        assert (a.cpu() - b)[passed].abs().max() < (1e-3 if dtype == torch.float32 else 1e-11)
    assert (there.transmittance.cpu() - here.transmittance)[passed].abs().max() < 1e-4


@needs_cuda
@pytest.mark.parametrize("name", NAMES)
def test_no_synchronisation_on_cuda(name: str) -> None:
    lens = focused(name)
    start = on("cuda", *bundle(lens, 3 * CHUNK + 5, torch.float32))
    trace(lens, *start, transmittance=True)  # what is set up once
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        trace(lens, *start, transmittance=True)
    finally:
        torch.cuda.set_sync_debug_mode("default")
