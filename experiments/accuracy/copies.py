"""Copies of lenses by models beside the exact trace of the same copies: spots, MTF, and the time of both.

Copies are drawn as `neurolens copies` draws them. Camera rays leave five points of the film (its middle, and four
at 70% of its radius) through a grid on the pupil, in three wavelengths, at f/4 (wide open where that is less). A spot
is what the rays' directions in the scene make on the film, by the derivatives of the exact lens; every copy is focused
as its lens is. Rays of all copies are one product of matrices with the model's derivatives, in float32. Errors are
beside the exact trace in float64. Its time is that of torch in float32, on the rays that may pass, for C would be
compiled anew for each copy. Writes copies.md and copies.json.
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import replace
from statistics import median
from typing import Any

import numpy as np
import torch
from torch import Tensor

from experiments import lab
from experiments.speed.compiled_source import CompiledSource
from neurolens.models.copied import Perturbed, copy_of
from neurolens.models.cores import DIRECTION, STOP
from neurolens.models.file import as_stored, read_model
from neurolens.models.fitted import FilmRays
from neurolens.models.model import LensModel
from neurolens.models.pairs import draw
from neurolens.models.perturbations import exact_answers, steps_of, with_perturbations
from neurolens.models.source import copies_program, fused_program
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.setting.copies import Off, Tolerances, draws_of
from neurolens.optics.setting.focusing import best_focus_z_mm
from neurolens.optics.setting.pupils import camera_rays
from neurolens.optics.trace.rays import trace

MODELS = (
    "brendel_tessar_100.ols-64", "canon_ef_85mm_f1_8_usm.ols-64", "laikin_double_gauss_50.ols-60",
    "nikon_zoom_70_200.ols-64", "tronnier_double_gauss_100.ols-64", "zeiss_planar_f1_4_55mm.ols-64",
)  # fmt: skip
PER_MM, WAVES_NM, SHARE, GRID, F_NUMBER = (20.0, 40.0), (480.0, 550.0, 630.0), 0.7, 48, 4.0
_STEP_MM, _ROUNDS = 1e-3, 500
Array = np.ndarray[Any, np.dtype[np.float64]]


def at_f_number(model: LensModel) -> LensModel:
    """Return the model stopped down."""
    radius_mm = model.domain.stop_radius_mm * min(1.0, first_order(model.lens).f_number / F_NUMBER)
    domain, lens = replace(model.domain, stop_radius_mm=radius_mm), model.lens.with_stop_radius(radius_mm)
    return replace(model, domain=domain, lens=lens)


def rays_of(model: LensModel) -> tuple[FilmRays, int]:
    """Return the rays of five film points, field by field, and how many each has; about a half of them pass."""
    d = model.domain
    film_z = min(max(best_focus_z_mm(model.lens, math.inf, d.wavelength_nm), d.film_z_mm[0]), d.film_z_mm[1])
    side = SHARE * d.film_radius_mm / math.sqrt(2)
    line = (np.arange(GRID) + 0.5) / GRID * 2 - 1
    x, y = (v.reshape(-1) for v in np.meshgrid(line, line))
    inside = np.hypot(x, y) < 1
    u, v = (d.pupil_radius_mm * c[inside] for c in (x, y))
    count = len(u) * len(WAVES_NM)
    rows = []
    for fx, fy in ((0, 0), (side, side), (-side, side), (-side, -side), (side, -side)):
        for nm in WAVES_NM:
            rows.append([np.full_like(u, fx), np.full_like(u, fy), np.full_like(u, film_z), u, v, np.full_like(u, nm)])
    return FilmRays(*(torch.from_numpy(c) for c in np.concatenate(rows, axis=1))), count


def to_film(model: LensModel, rays: FilmRays, count: int) -> tuple[Tensor, Tensor]:
    """Return which rays the lens passes, and for each field the matrix [5, 2, 2] from directions to film points."""
    base = exact_answers(model, model.lens, rays)
    columns = []
    for name in ("film_x", "film_y"):
        ahead, behind = (
            exact_answers(model, model.lens, replace(rays, **{name: getattr(rays, name) + s})).vectors[DIRECTION]
            for s in (_STEP_MM, -_STEP_MM)
        )
        columns.append(((ahead - behind) / (2 * _STEP_MM)).where(base.passed, 0.0))
    sums = torch.stack(columns, 1).reshape(2, 2, 5, count).sum(-1) / base.passed.reshape(5, count).sum(-1)
    return base.passed, torch.linalg.inv(sums.permute(2, 0, 1))


def figures(directions: Tensor, passed: Tensor, inverse: Tensor, field: Tensor) -> Array:
    """Return for each field the RMS spot (um), and contrasts of lines along x and along y at both frequencies: [5, 5].

    Args:
        directions: [2, N]. passed: [N]. field: [N] the number of each ray's field.
    """
    found = []
    for f in range(5):
        q = inverse[f] @ directions.double()[:, (field == f) & passed]
        q = q - q.mean(1, keepdim=True)
        rms = 1000 * q.square().sum(0).mean().sqrt()
        turns = (torch.exp(2j * math.pi * per_mm * q[a]).mean().abs() for per_mm in PER_MM for a in (0, 1))
        found.append([float(rms), *map(float, turns)])
    return np.array(found).T


def unit_answers(model: LensModel, rays: FilmRays) -> tuple[Tensor, Tensor]:
    """Return rows [1 + F, R, N] of the round model and of each figure's derivatives: direction, stop, gates."""
    nothing, field = Off.none(model.lens), model.encoding(rays)

    def rows(vectors: Array, scalars: Array) -> Tensor:
        found, others = model.core.copy(vectors, scalars)(field)  # type: ignore[attr-defined]
        return torch.cat(
            [found[DIRECTION], found[STOP] * model.scales.stop_mm / model.domain.stop_radius_mm, others[1:]]
        )

    v, s = nothing.vectors, nothing.scalars
    base, each = rows(v, s), []
    for k in range(v.size):
        one = v.reshape(-1).copy()
        one[k] = 1.0
        each.append(rows(one.reshape(v.shape), s) - base)
    for k in range(len(s)):
        one = s.copy()
        one[k] = 1.0
        each.append(rows(v, one) - base)
    return base, torch.stack(each)


def costs(model: LensModel, off: Off) -> lab.Row:
    """Return the milliseconds that setting a copy takes, and what its rays cost in C over those of the round model."""
    core, set_ms = model.core, []
    assert isinstance(core, Perturbed)
    for _ in range(20):
        began = time.perf_counter()
        copy = copy_of(model, off)
        set_ms.append(1000 * (time.perf_counter() - began))
    rays = draw(model.domain, 4096, seed=3)[0]
    names = ("film_x_mm", "film_y_mm", "pupil_x_mm", "pupil_y_mm", "wavelength_nm")
    columns: dict[str, Any] = dict(zip(names, rays.rows.numpy(), strict=True))
    columns |= {"film_z_mm": float(rays.film_z[0]), "stop_radius_mm": model.domain.stop_radius_mm}
    inputs = copies_program([model])
    state = off.figures[core.limits != 0]
    compiled = [CompiledSource(fused_program([one])) for one in (model, copy)] + [CompiledSource(inputs, state=state)]
    calls = [one.prepared(columns, one.outputs(4096)) for one in compiled]
    best = [math.inf] * 3
    for k in range(3 * _ROUNDS):
        began = time.perf_counter()
        calls[k % 3]()
        best[k % 3] = min(best[k % 3], time.perf_counter() - began)
    return {"set_ms": min(set_ms), "in_c": best[1] / best[0], "inputs_in_c": best[2] / best[0], "inputs": len(state)}


def may_pass(model: LensModel, base: Tensor, each: Tensor) -> tuple[Tensor, Tensor]:
    """Return which rays [N] may pass in any copy within the limits, and which of them may be blocked in any."""
    bent, turned = steps_of(model.lens, Tolerances())
    limits = torch.tensor([s.limit for s in bent for _ in "xy"] + [s.limit for s in turned], dtype=torch.float64)
    reach = torch.einsum("f,frn->rn", limits, each.abs())
    radius, more = base[2:4].norm(dim=0), reach[2:4].norm(dim=0)
    blocked = (base[4:] > reach[4:]).any(0) | (radius - more > 1)
    sure = (base[4:] <= -reach[4:]).all(0) & (radius + more <= 1)
    return ~blocked, ~sure


def compare(name: str, number: int, seed: int) -> lab.Row:
    """Measure one lens."""
    model = read_model(lab.MODELS / f"{name}.onnx").at()
    began = time.process_time()
    (model,) = as_stored([with_perturbations(model)])
    fit_s = time.process_time() - began
    model, whole = at_f_number(model), model
    rays, count = rays_of(model)
    nominal, inverse = to_film(model, rays, count)
    began = time.process_time()
    base, each = unit_answers(model, rays)
    kept, unsure = may_pass(model, base, each)
    base, each, unsure = base[:, kept], each[..., kept], unsure[kept]
    used = each.flatten(1).any(1)
    ways = each[used, :2].flatten(1).float()
    bounds, limits = each[used, 2:][..., unsure].flatten(1).float(), base[2:, unsure].float()
    set_s = time.process_time() - began
    rays, nominal = rays.select(kept), nominal[kept]
    field = torch.arange(5).repeat_interleave(count)[kept]
    draws = list(draws_of(model.lens, Tolerances(), number, seed))
    rows = [np.concatenate([o.vectors.reshape(-1), o.scalars]) for o, _ in draws]
    offs, first = torch.from_numpy(np.stack(rows))[:, used].float(), base[:2].flatten().float()
    directions, through = torch.empty((number, 2, len(rays))), (~unsure).repeat(number, 1)
    began = time.process_time()
    for some in torch.arange(number).split(8):
        torch.addmm(first, offs[some], ways, out=(out := directions[some[0] : some[-1] + 1].view(len(some), -1)))
        tests = (offs[some] @ bounds).reshape(len(some), *limits.shape) + limits
        through[some[0] : some[-1] + 1, unsure] = (tests[:, :2].square().sum(1) <= 1) & (tests[:, 2:] <= 0).all(1)
        del out
    model_s = (time.process_time() - began) / number
    start = camera_rays(rays.film_x, rays.film_y, rays.film_z, rays.pupil_x, rays.pupil_y, model.domain.pupil_z_mm)
    start, waves = start._replace(**{k: v.float() for k, v in start._asdict().items()}), rays.wavelength_nm.float()
    trace_s, exact, fast = 0.0, [], []
    for k, (_, lens) in enumerate(draws):
        began = time.process_time()
        with torch.no_grad():
            trace(lens, start, waves)
        trace_s += (time.process_time() - began) / number
        answer = exact_answers(model, lens, rays)
        exact.append(figures(answer.vectors[DIRECTION], answer.passed, inverse, field))
        fast.append(figures(directions[k], through[k], inverse, field))
    plain = figures(exact_answers(model, model.lens, rays).vectors[DIRECTION], nominal, inverse, field)
    a, b = np.stack(exact), np.stack(fast)  # [copies, figure, field]
    off = np.abs(b / a - 1)[:, 0]
    mtf = np.abs(b - a)[:, 1:]
    return {
        "lens": name, "rays": len(rays), "copies": number, "fit_s": fit_s, "set_s": set_s,
        "spot_um": float(plain[0].mean()), "spot_10_um": float(np.quantile(a[:, 0], 0.1)),
        "spot_90_um": float(np.quantile(a[:, 0], 0.9)),
        "spot_off": float(off.max()), "spot_off_median": float(np.median(off)),
        "mtf20_off": float(mtf[:, :2].max()), "mtf40_off": float(mtf[:, 2:].max()),
        "mtf40": float(np.median(a[:, 3:, 0])), "mtf40_worst": float(np.median(a[:, 3:, 1:])),
        "trace_ms": 1000 * trace_s, "model_ms": 1000 * model_s, "faster": trace_s / model_s,
        **costs(whole, draws[0][0]),
    }  # fmt: skip


_COLUMNS = lab.columns(
    ("lens", "lens"),
    ("spot as designed, um", "spot_um", ".1f"),
    ("of copies, 10% to", "spot_10_um", ".1f"),
    ("90%, um", "spot_90_um", ".1f"),
    ("MTF at 40/mm, middle", "mtf40", ".2f"),
    ("corners", "mtf40_worst", ".2f"),
    ("spot off, median, %", "spot_off_median", ".2f", 100),
    ("most, %", "spot_off", ".2f", 100),
    ("MTF off, 20/mm, most", "mtf20_off", ".4f"),
    ("40/mm, most", "mtf40_off", ".4f"),
    ("trace, ms", "trace_ms", ".1f"),
    ("model, ms", "model_ms", ".2f"),
    ("times faster", "faster", ".0f"),
    ("fit, s", "fit_s", ".1f"),
    ("set, ms", "set_ms", ".2f"),
    ("in C, times", "in_c", ".2f"),
    ("with inputs", "inputs_in_c", ".2f"),
    ("inputs", "inputs", "d"),
)
OPTIONS = (
    lab.count("number", 1000, "copies of each lens (default 1000)"), lab.count("seed", 0, "of the draws", least=0),
    lab.ONLY, lab.out(),
)  # fmt: skip


def run(args: argparse.Namespace) -> None:
    """Measure and write."""
    lab.quiet_glasses()
    names = lab.chosen(MODELS, lambda name: name, args.only, "copies")
    torch.set_num_threads(1)
    rows = [compare(name, args.number, args.seed) for name in lab.counted(names, "lenses", args.quiet)]
    worst = max(row["spot_off"] for row in rows)
    about = (
        f"- Spots: {100 * median(r['spot_off_median'] for r in rows):.2f}% off (median), at most {100 * worst:.2f}%.\n"
        f"- MTF: at most {max(r['mtf20_off'] for r in rows):.4f} off at 20/mm, "
        f"{max(r['mtf40_off'] for r in rows):.4f} at 40/mm.\n"
        f"- {min(r['faster'] for r in rows):.0f} to {max(r['faster'] for r in rows):.0f} times faster than the trace "
        "(CPU seconds of rays alone, one thread, float32).\n"
        f"- In C a copy costs at most {max(r['in_c'] for r in rows):.2f} times the round model, and at most "
        f"{max(r['inputs_in_c'] for r in rows):.2f} times where what is off is an input."
    )
    text = lab.page(
        "# Copies of lenses: models beside the exact trace of the same copies",
        f"`python -m experiments copies`: {args.number} copies of each lens within the default tolerances of\n"
        f"`neurolens copies`, {min(r['rays'] for r in rows)} to {max(r['rays'] for r in rows)} rays a copy.\n"
        + lab.machine_line(),
        about,
        lab.table(_COLUMNS, rows),
    )
    print(lab.write_results(args.out, "copies", text, {"lenses": rows}))
