"""The aberrations, measured."""

from __future__ import annotations

import numpy as np

from neurolens.evaluate.gallery.measures.view import View


def light_profile(view: View) -> dict[str, float]:
    """The radial profile of a light's image: how bright its core is over its rim, and its radius.

    The radius holds 95% of the light, about its centroid; the core is the inner third of it, the rim the outer third.
    """
    grey, (x, y) = view.grey, view.places_mm()
    total = grey.sum()
    if not total > 0:
        return {"radius_um": float("nan"), "core_over_rim": float("nan")}
    r = np.hypot(x - (x * grey).sum() / total, y - (y * grey).sum() / total)
    order = np.argsort(r, axis=None)
    share = np.cumsum(grey.ravel()[order]) / total
    radius = float(r.ravel()[order][np.searchsorted(share, 0.95)])
    core, rim = grey[r < radius / 3].mean(), grey[(r > 2 * radius / 3) & (r < radius)].mean()
    return {"radius_um": 1e3 * radius, "core_over_rim": float(core / rim)}
