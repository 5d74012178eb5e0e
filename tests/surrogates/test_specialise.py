"""A model for one wavelength is the model at that wavelength."""

from __future__ import annotations

from pathlib import Path

import lens_models
import pytest
import torch

from neurolens.base.errors import InputError
from neurolens.cameras.model import OnnxCamera, load_model
from neurolens.surrogates.domain import FilmRays, sample_domain
from neurolens.surrogates.export import export_onnx
from neurolens.surrogates.specialise import at_wavelength


@pytest.mark.parametrize("kind", ["invariants", "raw", "network", "zones", "residual"])
@pytest.mark.parametrize("wavelength_nm", [400.0, 587.6])
def test_one_wavelength(kind: str, wavelength_nm: float, tmp_path: Path) -> None:
    model = lens_models.model(kind)
    s = sample_domain(model.domain, 5000, 3)
    film_z = torch.full_like(s.film_z, model.domain.film_z_mm[0])
    rays = FilmRays(s.film_x, s.film_y, film_z, s.pupil_x, s.pupil_y, torch.full_like(s.film_x, wavelength_nm))
    expected = model.predict(rays)
    fixed = at_wavelength(model, wavelength_nm)
    found = fixed.predict(rays)
    assert torch.equal(found.status, expected.status)
    for a, b in zip((*found.rays, found.transmittance), (*expected.rays, expected.transmittance), strict=True):
        assert (a - b)[expected.status == 0].abs().max() < 1e-9

    lens = load_model(export_onnx(fixed, tmp_path / "fixed.onnx"), model.lens.sha256)
    camera = OnnxCamera(lens, film_mm=(36.0, 24.0), focus_m=2.0)
    assert not camera.dispersive and camera.wavelength_nm == (wavelength_nm, wavelength_nm)


def test_wavelengths_that_the_model_does_not_know() -> None:
    model = lens_models.model("invariants")
    with pytest.raises(InputError, match="400 to 700"):
        at_wavelength(model, 800.0)
    with pytest.raises(InputError, match="depend on the wavelength"):
        at_wavelength(at_wavelength(model, 500.0), 500.0)
