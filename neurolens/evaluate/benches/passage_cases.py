"""The lenses on which passage rates are measured, and what the theses say of them or of the nearest that they used."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Case:
    """A lens at one stop, and what the theses say of it (percent), by our names of the methods.

    Attributes:
        lens: stem of its file. focal_length_mm: that it is scaled to. f_number: of the stop.
        theirs: percent by method. source: where these stand, and of which lens if it is another.
    """

    lens: str
    focal_length_mm: float
    f_number: float
    theirs: dict[str, float] = field(default_factory=dict)
    source: str = ""


def _steinert(lens: str, mm: float, figures: dict[float, tuple[float, float]], name: str = "") -> list[Case]:
    source = f"Steinert 2009, Table 5.2{f', {name}' if name else ''}"
    return [Case(lens, mm, n, {"rear rim": a, "pixel disc": b}, source) for n, (a, b) in figures.items()]


# Lit pixels only for the fisheye's global pupil, as the table gives them too.
CASES = (
    *_steinert("muller_fisheye_100", 14.0, {4.0: (43.2, 64.4), 5.6: (29.7, 76.2), 8.0: (16.9, 79.7)}),
    *_steinert(
        "angenieux_retrofocus_35",
        35.0,
        {2.8: (25.4, 84.5), 4.0: (13.1, 85.4), 5.6: (7.7, 85.7)},
        "Kimura wide angle 36 mm",
    ),
    *_steinert("brendel_tessar_100", 50.0, {2.8: (60.7, 81.6), 4.0: (34.2, 83.7), 5.6: (18.0, 83.7)}),
    *_steinert(
        "sigler_telephoto_100",
        250.0,
        {5.6: (22.4, 86.7), 8.0: (15.8, 86.2), 11.0: (10.7, 86.2)},
        "Kingslake telephoto 250 mm",
    ),
    Case(
        "tronnier_double_gauss_100",
        100.0,
        4.0,
        {"rear rim": 36.9, "Wu, two steps": 92.2, "radial ellipses": 99.8},
        "Willi 2021, Table 3.1, double Gauss 100 mm",
    ),
    Case(
        "mizuguchi_fisheye_10",
        10.5,
        8.0,
        {"rear rim": 0.5, "Wu, two steps": 74.4, "pixel disc": 79.7, "radial ellipses": 88.7},
        "Willi 2021, Table 3.1",
    ),
    Case("laikin_double_gauss_50", 50.0, 1.8),
    Case("laikin_double_gauss_50", 50.0, 8.0),
)
# Those of the picture.
DRAWN = tuple(
    case
    for case in CASES
    if (case.lens, case.f_number)
    in (("laikin_double_gauss_50", 1.8), ("muller_fisheye_100", 4.0), ("mizuguchi_fisheye_10", 8.0))
)

# Steinert 2009, Table 5.3: percent of rays through the global pupil that pass, pixel (128, 96) of 512 x 384.
TABLE_5_3 = {2.8: 64.31, 4.0: 35.8, 5.6: 18.1, 8.0: 9.0, 11.0: 5.1, 16.0: 3.0, 22.0: 1.7, 32.0: 0.8, 45.0: 0.4}
