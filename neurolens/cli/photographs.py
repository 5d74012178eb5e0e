"""`neurolens verify LENS` and `neurolens rims LENS`: a lens file held against what photographs of the product measured,
and clear apertures fitted to the light that they show."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from neurolens.base.report import PART, Report
from neurolens.base.settings import WAVELENGTH_NM, changed, said, setting, wavelengths_nm, whole
from neurolens.cli import arguments as cli
from neurolens.optics.readers.any_format import read_any
from neurolens.optics.readers.lensfile import write_lens
from neurolens.optics.setting.states import focus_of, set_lens

if TYPE_CHECKING:
    from neurolens.optics.photographs.copy import FittedCopy
    from neurolens.optics.photographs.rims import FittedRims
    from neurolens.optics.photographs.verify import Comparison, Verified


@dataclass(frozen=True, kw_only=True)
class Verify(cli.Figures):
    """Compare a lens file with photographs: with the profiles that lensfun measured of 1,300 lenses.

    The profile is found by maker, focal length, f-number and name: the product that the file is believed to be, its
    name, or the name of the file itself. The command compares the shape of the distortion over image height, lateral
    colour in the broad bands of a camera, and light by aperture. A profile leaves the scale of the picture free, so the
    scale is taken out. Rays come from infinity; the distance of the photographs is not known. Needs the extras "train"
    and "photographs" (lensfunpy, which brings the profiles; their licence is CC BY-SA 3.0)."""

    epilog = """\
examples:
  neurolens verify sony_sonnar_55 -o sonnar.png
  neurolens verify "Nikon AF Nikkor 28mm f1.4D.zmx" --json
  neurolens verify my_lens.toml --profile "Canon EF 50mm f/1.2L USM" --lens-file my_verified_lens.toml"""
    kept = "only a finished picture or lens file is written"

    file: Path = cli.lens(positional=True)
    profile: str | None = setting(None, "lensfun's name of the lens, where it is not found by itself", metavar="NAME")
    out: Path | None = cli.output_path("OUT.png", "draw measured points and computed curves (png, pdf, svg)", None)
    lens_file: Path | None = setting(
        None, "write the lens with the result in its table [measured], which its models keep", metavar="OUT.toml",
        kind=Path, written=True,
    )  # fmt: skip

    def run(self) -> int:
        """Compare, draw, write."""
        from neurolens.optics.photographs.verify import FREE, plot_verified, verify

        tabled = read_any(self.file)
        found = verify(tabled, self.profile)
        if self.out is not None:
            plot_verified(found, self.out, tabled.believed_to_be or tabled.name)
        if self.lens_file is not None:
            write_lens(replace(tabled, measured=tuple(found.measured.items())), self.lens_file)
        files = [str(path) for path in (self.out, self.lens_file) if path is not None]
        return self.answer(Compared(str(self.file), tabled.name, found, found.measured, FREE, files))


@dataclass(frozen=True)
class Compared(Report):
    """What photographs say of a lens file, what its table [measured] keeps, and the files that were written."""

    file: str
    name: str
    found: Verified = field(metadata=PART)
    measured: Mapping[str, str | float]
    free: str
    files: list[str]

    def text(self) -> str:
        """A row a focal length, and the verdict."""
        found = self.found
        other = f"; also possible: {', '.join(found.also)}" if found.also else ""
        head = f"against lensfun's {found.profile}, crop {found.crop:g} (match of names: {found.certainty}{other})"
        header = "mm|distortion %|red µm|measured|blue µm|measured|f/8 stops|measured|widest|measured".split("|")
        table = cli.table(header, [_row(c) for c in found.comparisons])
        note = "distortion: residual of its shape; colour and light: computed and measured at the largest height"
        verdict = [f"- {sentence}" for sentence in found.verdict]
        return "\n".join([self.name, head, table, note, *verdict, self.free, *self.files])


def _row(c: Comparison) -> list[str]:
    from neurolens.optics.photographs.rims import near_f8

    cells = [f"{c.focal_mm:g}", cli.number(c.distortion_percent and c.distortion_percent.rms, 2)]
    light = c.light_stops
    eight, widest = (light[near_f8(light)], light[min(light)]) if light else (None, None)
    for curve, digits in ((c.red_um, 2), (c.blue_um, 2), (eight, 3), (widest, 3)):
        # At the largest height.
        last = (None, None) if curve is None else (float(curve.computed[-1]), float(curve.measured[-1]))
        cells += [cli.number(v, digits) for v in last]
    return cells


@dataclass(frozen=True, kw_only=True)
class Rims(cli.Figures):
    """Fit the rims of a lens file to photographs, so that the light falls off towards the corners as it was measured.

    On each side of the stop either the rims are scaled, or a ring of the mount is added; the fit takes all apertures
    together. Nothing cuts the beam of the axis, and no rim is wider than its neighbours allow. What is left has other
    causes: the sensor's shading, or a product that differs from the table. A zoom is fitted at its shortest focal
    length, and `neurolens verify` of the new file says how its others fare. The profile is found as by `neurolens
    verify`. Needs the extras "train" and "photographs".

    With --copy it finds what is off in one copy instead, from the contrasts that its photographs show in the middle and
    in the corners: the decentre of one element, tilt and swing of the film, its focus."""

    epilog = """\
examples:
  neurolens rims nikon_zoom_70_200 -o zoom.toml
  neurolens rims my_lens.toml --profile "Canon EF 50mm f/1.2L USM" --unused 1.4 2
  neurolens rims my_lens.toml --copy sharpness.csv --f-number 4 -o my_copy.toml"""
    kept = "only a finished lens file is written"

    file: Path = cli.lens(positional=True)
    profile: str | None = setting(None, "lensfun's name of the lens, where it is not found by itself", metavar="NAME")
    unused: tuple[float, ...] = setting(
        (), "f-numbers that the fit leaves out, to see what it is worth for them", within=(0.1, 100.0), nargs="+",
        metavar="N",
    )  # fmt: skip
    copy: Path | None = setting(
        None, "contrasts of one copy, as CSV or JSON with the columns x_mm, y_mm (in the picture, to the right and up "
        "from its middle), frequency_per_mm, tangential, sagittal", metavar="FILE", kind=Path, common=True,
    )  # fmt: skip
    element: int | None = setting(
        None, "with --copy: the first surface of the element that is off (default: each is tried)", kind=whole(0)
    )
    wavelengths: tuple[tuple[float, ...], ...] = setting(
        (), f"with --copy: the light in which it was measured, {said(WAVELENGTH_NM)} nm (default: d, F and C)",
        kind=wavelengths_nm, nargs="+", metavar="NM",
    )  # fmt: skip
    state: cli.LensState = cli.lens_state()
    out: Path | None = cli.output_path("OUT.toml", "write the lens with these rims", None)

    def run(self) -> int:
        """Fit, tell, write."""
        if self.copy and (self.profile or self.unused):
            self.refuse("--profile, --unused", "(given)", "these options only without --copy")
        if not self.copy and (self.element is not None or self.wavelengths or changed(self.state, unset=True)):
            self.refuse("--element, --f-number, ...", "(given)", "these options only with --copy")
        return self._rims() if self.copy is None else self._copy(self.copy)

    def _copy(self, measured: Path) -> int:
        """Fit what is off in one copy."""
        from neurolens.optics.analysis.fields import Scene
        from neurolens.optics.photographs.copy import fit_copy, read_measured

        tabled, shot = read_any(self.file), self.state.shot()
        lens = set_lens(tabled, shot)
        scene, light = Scene(lens, focus_of(lens, shot)), [nm for some in self.wavelengths for nm in some]
        found = fit_copy(scene, read_measured(measured), self.element, light)
        if self.out is not None:
            said = f"What is off is fitted by neurolens rims to {measured.name}."
            write_lens(replace(found.lens(tabled), notes=" ".join(filter(None, (tabled.notes, said)))), self.out)
        output = None if self.out is None else str(self.out)
        return self.answer(FoundCopy(str(self.file), tabled.name, str(measured), found, output))

    def _rims(self) -> int:
        """Fit rims to a profile."""
        from neurolens.optics.photographs.rims import fit_rims, with_fitted_rims
        from neurolens.optics.photographs.verify import found_for

        tabled = read_any(self.file)
        match, profiles, _ = found_for(tabled, self.profile)
        found = fit_rims(tabled, profiles[0], self.unused)
        if self.out is not None:
            said = f"Rims are fitted by neurolens rims to lensfun's {match.profile.model} ({match.certainty})."
            if any(ring.before == 0 for ring in found.rings):
                said += " A ring in front is surface 0: numbers of surfaces that are named before are now one higher."
            lens = with_fitted_rims(tabled, found)
            write_lens(replace(lens, notes=" ".join(filter(None, (lens.notes, said)))), self.out)
        output = None if self.out is None else str(self.out)
        return self.answer(Fitted(str(self.file), tabled.name, match.profile.model, match.certainty, found, output))


@dataclass(frozen=True)
class FoundCopy(Report):
    """What is off in a copy, by its measured sharpness, and the lens file that has it."""

    file: str
    name: str
    measured: str
    found: FittedCopy = field(metadata=PART)
    output: str | None

    def text(self) -> str:
        """What is off, with standard errors, and how well it fits."""
        found, off = self.found, self.found.error
        rows = [(name, cli.number(getattr(found, name), 4), cli.number(error, 2)) for name, error in off.items()]
        factors = ", ".join(f"{value:.3f} at {per_mm:g}/mm" for per_mm, value in found.factor.items())
        lines = [
            f"{self.name}: element of surfaces {found.element[0]}-{found.element[1]}",
            cli.table(("what is off", "fitted", "±"), rows),
            f"contrasts differ by {found.rms:.4f} (RMS; {found.rms_before:.4f} as designed)",
            f"of the sensor and the rest: {factors}",
            f"render it with --film-tilt {found.film_tilt_deg:.4g} --film-swing {found.film_swing_deg:.4g}",
        ]
        return "\n".join([*lines, *([f"Warning: {found.doubt}"] if found.doubt else [])])


@dataclass(frozen=True)
class Fitted(Report):
    """Rims that were fitted to the photographs of a profile, and the lens file that has them."""

    file: str
    name: str
    profile: str
    match: str
    found: FittedRims = field(metadata=PART)
    output: str | None

    def text(self) -> str:
        """The light that is left by aperture, and what was changed."""
        found = self.found
        rows = []
        for f, before in found.before_stops.items():
            left_out = "left out" if f in found.unused else ""
            rows.append([f"f/{f:g}", f"{before:.3f}", f"{found.after_stops[f]:.3f}", left_out])
        lines = [
            f"{self.name}: {self.profile} ({self.match})",
            cli.table(("aperture", "before", "after (stops RMS)", ""), rows),
        ]
        for name, factor in (("in front of the stop", found.front), ("behind it", found.rear)):
            lines.append(f"rims {name}: {'as they are' if factor == 1 else f'times {factor:.3f}'}")
        for ring in found.rings:
            place = "in front of the lens" if ring.before == 0 else f"behind surface {ring.before - 1}"
            lines.append(f"ring {ring.distance_mm:.1f} mm {place}, {2 * ring.radius_mm:.2f} mm wide")
        left, closed = max(found.after_stops.values()), found.after_stops[found.closed]
        lines.append(
            f"the light still differs by at most {left:.2f} stops; no rim explains the {closed:.2f} stops at f/8"
        )
        return "\n".join(lines)
