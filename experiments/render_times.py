"""Render time by camera and scene: Willi's Tables 6.2 and 6.3, with surrogates beside the lenses.

All cameras see the same 20 degrees at f/4, focused at 5 m: the film grows with the focal length. One wavelength per
path for all, for ideal cameras could share a path between four. Renders run in turn, in one process on one thread.
Source of the tables: Willi 2021 (multi-lens cameras in appleseed).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from experiments import lab
from experiments.lab import Report
from neurolens.base.errors import InputError
from neurolens.cameras.build import FUSED, Shot, make_camera
from neurolens.cameras.contract import RAYS_A_CALL, Camera
from neurolens.lens.apertures import Aperture
from neurolens.render.film_settings import FilmSettings
from neurolens.render.renderer import render
from neurolens.render.scene import Scene, load_scene

PINHOLE, THIN, STOP = "pinhole", "thin lens", "stop only"
TORCH, EXACT_C = "exact, torch", "exact, C"
GRAPHS = ("polynomial, onnxruntime", "network, onnxruntime")
FUSED_MODELS = ("polynomial, C", "network, C")
KINDS = (TORCH, EXACT_C, *GRAPHS, *FUSED_MODELS)
_FILES = dict(zip((*GRAPHS, *FUSED_MODELS), ("ols-64", "mlp-16x2") * 2, strict=True))
# Scenes of rising cost: one bounce off a wall; small lights, three; meshes, gloss, glass, six.
CHEAP = "cheap"
SCENES = {CHEAP: "grid", "middle": "lights", "dear": "room"}
CHEAP_ROUNDS = 4  # times the rounds of the other scenes: there the camera counts most, and a render is short
# Refractions, name, file of lenses/, focal length in mm.
LENSES = (
    (2, "biconvex", "thorlabs_lb1471_biconvex_50", 49.83),
    (7, "Tessar (Brendel)", "brendel_tessar_100", 100.0),
    (10, "double Gauss (Tronnier)", "tronnier_double_gauss_100", 100.72),
    (14, "double Gauss (Angenieux)", "angenieux_double_gauss_100", 99.94),
    (18, "zoom (Itoh)", "itoh_zoom_100_146", 99.92),
    (25, "retrofocus (Ikemori)", "ikemori_retrofocus_14", 14.28),
    (33, "zoom (Ogawa)", "ogawa_zoom_70_200", 72.12),
    (40, "zoom 70-200 (Nikon)", "nikon_zoom_70_200", 71.5),
)
_QUICK = (2, 14, 40)
_FILM = (0.36, 0.2025)  # of the focal length
_FOCUS_M, _F_NUMBER = 5.0, 4.0
_ALONE_ROUNDS, _SLOW_S = 15, 0.1


@dataclass(frozen=True)
class Size:
    """How much is rendered: pixels, samples per pixel, rounds."""

    width: int = 128
    height: int = 72
    samples: int = 16
    rounds: int = 5


@dataclass
class Subject:
    """A camera of the table.

    Attributes:
        refractions: of the lens, None for an ideal camera. kind: one of `KINDS`, or an ideal camera.
        camera: None where it cannot be made, `reason` says why. made_s: to make it, compiling included.
        ns, ns_moves: of a ray without and with differentials, camera alone, best of the rounds.
        moves_error: of differentials that are fitted, see `LensCamera`.
    """

    lens: str
    refractions: int | None
    kind: str
    camera: Camera | None = None
    reason: str = ""
    made_s: float = 0.0
    ns: float | None = None
    ns_moves: float | None = None
    moves_error: float | None = None

    @property
    def name(self) -> str:
        return self.kind if self.lens == self.kind else f"{self.lens}, {self.kind}"


@dataclass
class Timed:
    """A camera in a scene: seconds of every round, in all and in the camera, and the share of rays that pass."""

    subject: Subject
    scene: str
    differentials: bool
    seconds: list[float] = field(default_factory=list)
    camera_s: list[float] = field(default_factory=list)
    passed: float = 0.0
    paths: int = 0


def make_subjects(quick: bool, report: Report) -> list[Subject]:
    """All cameras; one that this machine cannot make says why."""
    specs: list[tuple[Subject, str, float]] = [
        (Subject(PINHOLE, None, PINHOLE), "pinhole", 50.0),
        (Subject(THIN, None, THIN), "thin", 50.0),
        (Subject(STOP, 0, STOP), str(lab.ROOT / "experiments" / "lenses" / "stop_only_50.toml"), 50.0),
    ]
    for count, lens, stem, efl in LENSES:
        for kind in KINDS if not quick or count in _QUICK else ():
            file = lab.MODELS / f"{stem}.{_FILES[kind]}.onnx" if kind in _FILES else lab.LENSES / f"{stem}.toml"
            compiled = FUSED if kind in (EXACT_C, *FUSED_MODELS) else ""
            specs.append((Subject(lens, count, kind), f"{compiled}{file}", efl))
    for k, (subject, spec, efl) in enumerate(specs):
        began = time.perf_counter()
        try:
            subject.camera = make_camera(spec, shot(efl, spec))
            _differentials(subject.camera, 1)
            subject.moves_error = getattr(subject.camera, "differentials_error", None)
        except InputError as error:
            subject.reason = str(error).replace(f"{lab.ROOT}/", "")
        subject.made_s = time.perf_counter() - began
        report((k + 1) / len(specs))
    return [subject for subject, _, _ in specs]


def shot(efl: float, spec: str, aperture: Aperture | None = None) -> Shot:
    """What every camera is set to."""
    f_number = None if spec == "pinhole" else _F_NUMBER
    return Shot((_FILM[0] * efl, _FILM[1] * efl), _FOCUS_M, f_number, aperture=aperture)


def _differentials(camera: Camera, count: int) -> Callable[[], object] | None:
    """A call that samples rays with differentials, run once; None for a camera without them."""
    film, square, wavelength = _inputs(camera, count)
    ask = camera.sample_differentials  # type: ignore[attr-defined]
    try:
        ask(film, square, wavelength)
    except InputError:
        return None
    return lambda: ask(film, square, wavelength)


def _inputs(camera: Camera, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same random numbers for every camera: points over the film and the pupil's square, wavelengths."""
    rng = np.random.default_rng(1)
    film = (rng.random((2, count)) - 0.5) * np.array(camera.film_mm)[:, None]
    low, high = camera.wavelength_nm or (400.0, 700.0)
    wavelength = np.clip(rng.uniform(400, 700, count), low, high)
    return film.astype(np.float32), rng.random((2, count), np.float32), wavelength.astype(np.float32)


def time_alone(subjects: Sequence[Subject], report: Report) -> None:
    """Nanoseconds a ray of every camera by itself, with and without differentials, in turn."""
    calls: list[tuple[Subject, str, int, Callable[[], object]]] = []
    for s in subjects:
        if s.camera is not None:
            count = getattr(s.camera, "rays_a_call", RAYS_A_CALL)
            film, square, wavelength = _inputs(s.camera, count)
            sample = s.camera.sample
            calls.append((s, "ns", count, lambda f=sample, a=(film, square, wavelength): f(*a)))  # type: ignore[misc]
            moves = _differentials(s.camera, count)
            if moves is not None:
                calls.append((s, "ns_moves", count, moves))
    for k in range(_ALONE_ROUNDS):
        for s, what, count, call in calls:
            known: float | None = getattr(s, what)
            if known is not None and known * count > _SLOW_S * 1e9:
                continue  # a tenth of a second a call is measured well enough by one
            began = time.perf_counter()
            call()
            taken = (time.perf_counter() - began) / count * 1e9
            setattr(s, what, taken if known is None else min(known, taken))
        report((k + 1) / _ALONE_ROUNDS)


def load_scenes(quick: bool) -> dict[str, Scene]:
    """The scenes by what they cost."""
    chosen = list(SCENES.items())[: 1 if quick else 3]
    return {cost: load_scene(lab.SCENES / f"{name}.toml") for cost, name in chosen}


def time_renders(subjects: Sequence[Subject], scenes: dict[str, Scene], size: Size, report: Report) -> list[Timed]:
    """Every camera in every scene; in the cheap one also with differentials, where they take no minute."""
    rows = []
    for cost in scenes:
        for s in subjects:
            if s.camera is not None:
                rows.append(Timed(s, cost, False))
                if cost == CHEAP and s.ns_moves is not None and s.kind not in {TORCH, *GRAPHS}:
                    rows.append(Timed(s, cost, True))  # right after, for their ratio
    rounds = {cost: size.rounds * (CHEAP_ROUNDS if cost == CHEAP else 1) for cost in scenes}
    for k in range(max(rounds.values())):
        for i, row in enumerate(rows):
            if k < rounds[row.scene]:
                assert row.subject.camera is not None
                stats = one_render(scenes[row.scene], row.subject.camera, size, row.differentials)
                row.seconds.append(stats["seconds"])
                row.camera_s.append(stats["camera_thread_seconds"])
                row.passed, row.paths = stats["passed_fraction"], int(stats["paths"])
            report((k + (i + 1) / len(rows)) / max(rounds.values()))
    return rows


def one_render(scene: Scene, camera: Camera, size: Size, differentials: bool = False) -> dict[str, float]:
    """Statistics of one render."""
    film = FilmSettings(wavelengths="one")
    if differentials:
        camera = _WithDifferentials(camera)
    done = render(
        scene, camera, width=size.width, height=size.height, samples=size.samples, seed=1, threads=1, film=film
    )  # fmt: skip
    return done.stats


class _WithDifferentials:
    """A camera that computes the differentials of all its rays, which the renderer does not use: to time them."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self.sample = camera.sample_differentials  # type: ignore[attr-defined]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._camera, name)

    def for_worker(self) -> _WithDifferentials:
        """This camera about the one that the camera has for a worker."""
        opener = getattr(self._camera, "for_worker", None)
        return _WithDifferentials(opener() if opener else self._camera)


@dataclass
class Shape:
    """A shape of the biconvex lens's stop: area over that of the round one, rays that pass, seconds of every round."""

    name: str
    aperture: Aperture | None
    area: float
    passed: float = 0.0
    seconds: list[float] = field(default_factory=list)


def shapes() -> list[Shape]:
    """The round stop, 5 and 50 straight edges, a star and a heart, with their areas over the circle's."""
    found = [Shape("round", None, 1.0)]
    for n in (5, 50):
        found.append(Shape(f"{n} edges", Aperture(blades=n), n / 2 * np.sin(2 * np.pi / n) / np.pi))
    side = (np.arange(1024) + 0.5) / 512 - 1
    x, y = np.meshgrid(side, -side)
    # A star of five points whose inner corners lie at 0.48 of the radius; a heart, (x^2 + y^2 - 1)^3 <= x^2 y^3.
    part = np.mod(np.arctan2(x, y) + np.pi / 5, 2 * np.pi / 5) - np.pi / 5
    across, along = np.hypot(x, y) * np.abs(np.sin(part)), np.hypot(x, y) * np.cos(part)
    inner = 0.48 * np.array([np.sin(np.pi / 5), np.cos(np.pi / 5)])
    star = along <= 1 - across * (1 - inner[1]) / inner[0]
    u, v = 1.5 * x, 1.5 * y + 0.1
    heart = (u * u + v * v - 1) ** 3 <= u * u * v**3
    disc = x * x + y * y <= 1
    for name, mask in (("star", star), ("heart", heart)):
        found.append(Shape(name, Aperture(mask=mask & disc), float((mask & disc).sum() / disc.sum())))
    return found


def time_shapes(scene: Scene, size: Size, report: Report) -> list[Shape]:
    """The biconvex lens, compiled, with every shape of its stop."""
    _, _, stem, efl = LENSES[0]
    spec = f"{FUSED}{lab.LENSES / stem}.toml"
    found = shapes()
    try:
        cameras = [make_camera(spec, shot(efl, spec, shape.aperture)) for shape in found]
    except InputError:
        return []
    for k in range(size.rounds):
        for shape, camera in zip(found, cameras, strict=True):
            stats = one_render(scene, camera, size)
            shape.seconds.append(stats["seconds"])
            shape.passed = stats["passed_fraction"]
        report((k + 1) / size.rounds)
    return found
