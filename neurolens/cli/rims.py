"""`neurolens rims LENS`: clear apertures from the light that photographs of the product measured."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from neurolens.base.settings import setting
from neurolens.cli.arguments import Answering, Glasses, check_suffix, lens, output_path
from neurolens.cli.output import table

if TYPE_CHECKING:
    from neurolens.photographs.rims import FittedRims


@dataclass(frozen=True, kw_only=True)
class Rims(Glasses, Answering):
    """Fit the rims of a lens file to photographs: on each side of the stop either the rims are scaled, or a ring of the
    mount is added, so that the light over image height is the measured one at all apertures together.

    Nothing cuts the beam of the axis, and no rim is wider than its neighbours allow. What is left has other causes: the
    sensor's shading, or a product that differs from the table. The profile is found as `neurolens verify` finds it.
    Needs the extras "train" and "photographs"."""

    about: ClassVar[str] = "fit the rims of a lens file to photographs of the product"
    epilog: ClassVar[str] = """\
examples:
  neurolens rims lenses/sony_sonnar_55.toml -o sonnar.toml
  neurolens rims my_lens.toml --profile "Canon EF 50mm f/1.2L USM" --unused 1.4 2"""
    kept: ClassVar[str] = "only a finished lens file is written"

    file: Path = lens(positional=True)
    profile: str | None = setting(None, "lensfun's name of the lens, where it is not found by itself", metavar="NAME")
    unused: tuple[float, ...] = setting(
        (), "f-numbers that the fit leaves out, to see what it is worth for them", within=(0.1, 100.0), nargs="+",
        metavar="N",
    )  # fmt: skip
    out: Path | None = output_path("OUT.toml", "write the lens with these rims", None)

    def run(self) -> int:
        """Fit, tell, write."""
        if self.out is not None:
            check_suffix(self.out, "--output", (".toml",))
        from neurolens.photographs.rims import fit_rims, with_fitted_rims
        from neurolens.photographs.verify import found_for
        from neurolens.readers.any_format import read_any
        from neurolens.readers.lensfile import write_lens

        tabled = read_any(self.file)
        match, profiles, _ = found_for(tabled, self.profile)
        found = fit_rims(tabled, profiles[0], self.unused)
        if self.out is not None:
            said = f"Rims are fitted by neurolens rims to lensfun's {match.profile.model} ({match.certainty})."
            lens = with_fitted_rims(tabled, found)
            write_lens(replace(lens, notes=" ".join(filter(None, (lens.notes, said)))), self.out)
        data = {"file": str(self.file), "profile": match.profile.model, "match": match.certainty, **found.to_dict()}
        data["output"] = None if self.out is None else str(self.out)
        return self.answer(data, lambda: _text(found, f"{tabled.name}: {match.profile.model} ({match.certainty})"))


def _text(found: FittedRims, head: str) -> str:
    rows = [
        [
            f"f/{f:g}",
            f"{found.before_stops[f]:.3f}",
            f"{found.after_stops[f]:.3f}",
            "left out" if f in found.unused else "",
        ]
        for f in found.before_stops
    ]
    lines = [head, table(("aperture", "before", "after (stops RMS)", ""), rows)]
    for name, factor in (("in front of the stop", found.front), ("behind it", found.rear)):
        lines.append(f"rims {name}: {'as they are' if factor == 1 else f'times {factor:.3f}'}")
    for ring in found.rings:
        place = "in front of the lens" if ring.before == 0 else f"behind surface {ring.before - 1}"
        lines.append(f"ring {ring.distance_mm:.1f} mm {place}, {2 * ring.radius_mm:.2f} mm wide")
    left, closed = max(found.after_stops.values()), found.after_stops[found.closed]
    lines.append(f"left: at most {left:.2f} stops; rims cannot explain what is left at f/8 ({closed:.2f})")
    return "\n".join(lines)
