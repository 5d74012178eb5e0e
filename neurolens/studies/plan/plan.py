"""Plans the camera for a scene within an error: what each effect of the lens is worth, and the camera to use.

A camera's error is how far its footprints are from the exact lens's in pixels, and how far its light is, at the places
of a scene that a `probe` finds; both are counted at the 95th percentile over the picture. Its price is the time of the
picture to the noise that the exact lens has with the scene's samples, in seconds of one thread's processor: see
`costs`. The cheapest camera within the budget is chosen. Those that take about as long are alike, and the exact lens is
taken where it is one of them.

In our renderer the whole picture counts: what a path takes besides its camera, and how dispersion adds to noise, are
measured on strips of it. In other targets the camera alone counts; there cameras are alike up to `pages.SAVING`,
because what else a path takes is not known.

A plan should take at most a tenth of its picture's time. So it renders strips in proportion to the picture, tries no
model where none could save enough, and looks for the light that the lens adds, which takes seconds, only where a tenth
of the picture's time has room for that.
"""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from neurolens.base.errors import InputError
from neurolens.base.lensname import split_kind
from neurolens.base.report import BULK
from neurolens.base.tomlfile import format_toml
from neurolens.optics.lens.prescription import Lens
from neurolens.pictures.render.scene import Scene
from neurolens.studies.pages import SAVING, recommended
from neurolens.studies.plan.candidates import EXACT, Choice, Target, candidates
from neurolens.studies.plan.costs import ALONE, Work, noise, ns_a_ray, work_of
from neurolens.studies.plan.probe import Effect, Probe, SceneNeeds, effects_of, probe

ALIKE = 1.2  # whose pictures take up to so many times the least: prices are no more accurate
SHARE = 0.1  # the most that a plan should take of its picture's time
_WHOLE_S = 60.0  # CPU seconds of a plan with the light that the lens adds: 40 to 87 in the 24 cases of `plans`


@dataclass(frozen=True)
class Plan:
    """A scene's needs, its effects by falling worth, every camera tried by rising seconds, and the one to use.

    Attributes:
        work: what a path takes besides its camera; none where the camera alone counts.
        alike: names of the cameras within the budget that take about as long as the cheapest; the best is one of them.
    """

    target: Target
    budget_px: float
    asked: SceneNeeds
    work: Work
    effects: tuple[Effect, ...]
    choices: tuple[Choice, ...]
    best: Choice | None
    alike: tuple[str, ...]
    probed: Probe = field(metadata=BULK, repr=False)

    def to_toml(self, folder: Path) -> str:
        """The text of a file in a folder, which `render` and `export` take for the best camera."""
        assert self.best is not None
        kind, path = split_kind(self.best.camera)
        title = f"{self.probed.lens.name}: {self.best.name}"
        return format_toml({"title": title, "camera": f"{kind}{os.path.relpath(path, folder)}"})


def plan(
    scene: Scene, lens: Lens, budget_px: float = 0.25, *, target: Target = "render", models: Sequence[Path] = (),
    folder: Path | None = None, explain: bool = False,
) -> Plan:  # fmt: skip
    """Find the cheapest camera for a scene within a budget of error.

    Where the cheapest camera saves too little to tell, it is the exact lens. In our renderer the whole picture counts.

    Args:
        lens: in its zoom state. budget_px: error of place and blur in pixels of the scene's picture.
        target: what runs the camera: our renderer with all it has, compiled C, or onnxruntime.
        models: exported models of this lens to try. folder: where models fitted for the shot go; None fits none.
        explain: whether cameras beyond the budget are compiled and timed, too (else their seconds are infinite), and
            the light that the lens adds is looked for, however long that takes.

    Raises:
        InputError: a budget is negative or no number; as `probe`.
    """
    if not budget_px >= 0:
        raise InputError("plan", "budget_px", budget_px, "0 or more pixels")
    probed = probe(scene, lens)
    work = work_of(probed) if target == "render" else ALONE
    if not explain and exact_suffices(probed, work):
        models, folder = (), None
    tried = candidates(probed, budget_px, target, models=models, folder=folder, explain=explain)
    return decided(probed, tried, budget_px, target, work, explain)


def exact_suffices(probed: Probe, work: Work) -> bool:
    """Return whether even a model that costs nothing would save too little, so that nothing needs to be fitted."""
    rest = work.rest[probed.exact.dispersive]
    exact = ns_a_ray(probed.exact, probed.places) if rest else math.inf
    return recommended((0.0,), float, exact, rest, ALIKE) == exact


def decided(
    probed: Probe, tried: Sequence[Choice], budget_px: float, target: Target, work: Work, explain: bool = True
) -> Plan:
    """Decide the plan for a budget, from candidates that serve it; see `plan`."""
    saving = ALIKE if work.whole else SAVING
    choices = priced(probed, tried, work)
    held = [c for c in choices if c.meets(budget_px)]
    exact = next((c for c in held if c.name == EXACT and math.isfinite(c.seconds)), None)
    best = recommended(held, lambda c: c.seconds, exact, saving=saving)
    alike = tuple(c.name for c in held if c.seconds <= saving * held[0].seconds)
    stray = explain or best is None or not work.whole or SHARE * best.seconds > _WHOLE_S
    effects = effects_of(probed, budget_px, stray)
    return Plan(target, budget_px, probed.asked, work, effects, choices, best, alike, probed)


def priced(probed: Probe, tried: Sequence[Choice], work: Work) -> tuple[Choice, ...]:
    """Return cameras by rising seconds, to the noise that the exact lens has with the scene's samples."""
    shot = probed.scene.settings.camera
    exact = noise(probed.seen.weight, probed.places.share) * work.noise[probed.exact.dispersive]
    paths = 1e-9 * shot.width * shot.height * shot.samples / exact

    def price(c: Choice) -> Choice:
        return replace(c, seconds=paths * c.noise * work.noise[c.disperses] * (c.ns + work.rest[c.disperses]))

    return tuple(sorted(map(price, tried), key=lambda c: c.seconds))
