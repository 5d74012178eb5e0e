"""The pages of results: a question each, answered in two sentences, one plot and one small table.

A page says nothing that is not in the files which the measurements have written to experiments/results with `--commit`
(and models/index.json), but for what papers state: run it again after each of them. It measures nothing itself, and
takes seconds.
"""

from __future__ import annotations

import argparse
import json
import re
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from posixpath import normpath
from typing import Any

from experiments import lab
from experiments.data.make_models import errors_by_kind
from neurolens.base.files import atomic_write_text
from neurolens.optics.analysis.plots import FIELD_COLOURS, drawing, plain_log_ticks

PAGES = lab.ROOT / "docs" / "pages"
BLUE, ORANGE, GREEN, RED, *_ = FIELD_COLOURS
GREY = FIELD_COLOURS[-1]
PIXEL_UM = 5.0
MACHINE = "Measured on one core of a 2.6 GHz AMD EPYC with AVX-512 in November 2026."


@dataclass(frozen=True)
class Answer:
    """What a page says: the question, the answer in two sentences, a plot, a table, and where the figures come from.

    Attributes:
        short: the answer in a few words, for the list of all questions.
        draw: draws the plot into a figure; `plot` says in a sentence what it shows.
        commands: of the measurements, each with the page that it writes, below experiments/results.
        conditions: what the figures hold for.
        more: other tables on the same question, with what each shows.
    """

    name: str
    question: str
    short: str
    answer: str
    plot: str
    draw: Callable[[Any], None]
    header: str
    rows: Sequence[Sequence[str]]
    commands: Sequence[tuple[str, str]]
    conditions: str
    more: Sequence[tuple[str, str]] = ()

    def page(self) -> str:
        """The page in Markdown, for docs/pages/results."""
        measured = [
            f"- `{command}`: [all figures](../../../{normpath('experiments/results/' + page)})"
            for command, page in self.commands
        ]
        more = [f"- [{text[0].upper()}{text[1:]}](../../../{page})" for page, text in self.more]
        return lab.page(
            f"# {self.question}",
            self.answer,
            f"![{self.plot}]({self.name}.png)",
            f"*{self.plot}*",
            lab.table(self.header, self.rows),
            "## Measured by",
            "\n".join(measured),
            self.conditions,
            *(["## More on this", "\n".join(more)] if more else []),
        )


@cache
def results(name: str) -> Any:
    return json.loads((lab.RESULTS / f"{name}.json").read_text(encoding="utf-8"))


def short(value: float, digits: int = 2) -> str:
    """A figure of so many digits, without an exponent."""
    return f"{float(f'{value:.{digits}g}'):,.10g}"


def share(value: float) -> str:
    return f"{short(100 * value)}%"


def span(values: Sequence[float], digits: int = 2) -> str:
    return f"{short(min(values), digits)} to {short(max(values), digits)}"


def bars(
    axis: Any, names: Sequence[str], values: Sequence[float], colours: Sequence[str], label: str, digits: int = 2
) -> None:
    """Horizontal bars from the first name down, each with its figure beside it."""
    drawn = axis.barh(range(len(names)), values, color=colours, height=0.7)
    axis.bar_label(drawn, [short(value, digits) for value in values], padding=4, fontsize=9)
    axis.set_yticks(range(len(names)), names)
    axis.invert_yaxis()
    axis.set_xlabel(label)
    axis.grid(axis="x")


def curve(axis: Any, values: Sequence[float], name: str, colour: str) -> None:
    """Values in order against the share of cases that have no more."""
    ordered = sorted(values)
    axis.plot([100 * (k + 1) / len(ordered) for k in range(len(ordered))], ordered, color=colour, label=name)


# ---- Models. ---------------------------------------------------------------------------------------------------------


def models() -> Answer:
    rows = json.loads((lab.MODELS / "index.json").read_text(encoding="utf-8"))["models"]
    kinds = {
        (form, kind): values for form in ("ols-64", "mlp-16x2") for kind, values in errors_by_kind(rows, form).items()
    }
    kind, named = "round photographic lenses", "lenses by name"
    titles = {"ols-64": "polynomial of 64 coefficients", "mlp-16x2": "network of two layers of 16"}

    def draw(figure: Any) -> None:
        axis = figure.subplots()
        for colour, form in zip((BLUE, ORANGE), titles, strict=True):
            both = [*kinds[form, kind], *kinds[form, named]]
            curve(axis, both, f"{titles[form]}, {len(both)} lenses", colour)
        axis.axhline(PIXEL_UM, color=GREY, linestyle="--", label="a pixel of 5 um")
        axis.set(
            yscale="log", xlabel="share of the lenses with at most this error, %", ylabel="RMS error on the film, um"
        )
        plain_log_ticks(axis.yaxis)
        axis.legend()
        axis.grid()

    table = [
        [lenses, titles[form], str(len(values)), short(statistics.median(values)), short(max(values))]
        for form, lenses in [
            ("mlp-16x2", kind),
            ("mlp-16x2", named),
            ("ols-64", kind),
            ("ols-64", named),
            *((form, "anamorphic lenses") for form in titles),
            ("mlp-16x2", "single elements"),
        ]
        for values in [kinds[form, lenses]]
    ]
    clipped = [r for r in results("clipping")["rows"] if r["model"] == "mlp-16x2"]
    worst = max(max(r["false_pass"], r["false_block"]) for r in clipped)
    network, polynomial = kinds["mlp-16x2", kind], kinds["ols-64", named]
    return Answer(
        "models",
        "How exact is a model?",
        f"median {short(statistics.median(network))} um; a pixel is {PIXEL_UM:g} um",
        f"Of the models that ship, a network leaves {short(statistics.median(network))} um RMS on the film (median of "
        f"{len(network)} round photographic lenses, worst {short(max(network))}) and a polynomial "
        f"{short(statistics.median(polynomial))} um (median of {len(polynomial)} lenses by name, worst "
        f"{short(max(polynomial))}). The networks pass or block at most {share(worst)} of the rays wrongly; the "
        "networks of condensers and of a fast singlet are poor, and their cards say so.",
        "RMS error on the film of the models that ship, from the best lens to the worst.",
        draw,
        "lenses|model|number|median um|worst um",
        table,
        [("python -m experiments models", "../../models/README.md"), ("python -m experiments clipping", "clipping.md")],
        "The errors are those of rays that no fit has seen, over the whole film, stop and focus, and 400 to 700 nm.",
        [
            ("experiments/results/zoom.md", "one model for a whole zoom: `python -m experiments zoom`"),
            ("experiments/results/inverse.md", "from the scene back to the film: `python -m experiments inverse`"),
            (
                "experiments/results/vignetting.md",
                "stopped down, without another fit: `python -m experiments vignetting`",
            ),
            ("experiments/results/shots.md", "a model of one shot alone: `python -m experiments shots`"),
            ("experiments/results/ablations/laikin_double_gauss_50.md", "what each part of a fit is worth"),
            ("experiments/results/phase.md", "the optical path of models: `python -m experiments phase`"),
            ("experiments/results/copies.md", "models of decentred copies: `python -m experiments copies`"),
        ],
    )


METHODS = {  # with the place of its label beside its dot, in points
    "thin": ("thin lens", (8, -3)),
    "hanika-d5": ("dense polynomial, Hanika 2014", (10, 30)),
    "schrade-40": ("OMP, Schrade 2016", (-150, -12)),
    "rtf-d6": ("ray transfer, Goossens 2022", (8, -3)),
    "ray-lut-32": ("table of rays, Honsbrok 2025", (-162, -6)),
    "ols-64": ("ours, polynomial", (-104, -18)),
    "mlp-16x2": ("ours, network", (-104, -10)),
}


def methods() -> Answer:
    text = (lab.RESULTS / "surrogates" / "laikin_double_gauss_50.md").read_text(encoding="utf-8")
    header, _, *lines = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("| ")]
    found = {cells[0].partition(",")[0]: cells for cells in lines}
    at = {name: header.index(name) for name in ("RMS um", "fused ns/ray", "false pass %")}

    def figure_of(method: str, name: str) -> float:
        return float(found[method][at[name]])

    passed = [figure_of(method, "false pass %") for method in METHODS if method[:3] in ("han", "sch", "rtf", "ray")]
    exact, hand = as_c(12)[0], by_hand(12)

    def draw(figure: Any) -> None:
        axis = figure.subplots()
        for method in found:
            if "\u2013" in (found[method][at["RMS um"]], found[method][at["fused ns/ray"]]):
                continue
            colour = BLUE if method.startswith(("ols", "mlp")) else GREY if method in ("thin", "thick") else ORANGE
            place = figure_of(method, "fused ns/ray"), figure_of(method, "RMS um")
            axis.plot(*place, "o", color=colour)
            if method in METHODS:
                title, offset = METHODS[method]
                line = {"arrowstyle": "-", "linewidth": 0.6, "shrinkB": 3}
                paper = {"facecolor": "white", "edgecolor": "none", "pad": 1}  # that no line crosses the words
                axis.annotate(title, place, offset, textcoords="offset points", fontsize=9, arrowprops=line, bbox=paper)
        for name, ns, style in (("exact, as C", exact, "--"), ("exact, by hand, bare", hand, ":")):
            axis.axvline(ns, color="black", linestyle=style, linewidth=1, label=f"{name}: {short(ns)} ns")
        axis.legend(loc="upper right")
        axis.set(xscale="log", yscale="log", xlabel="ns a ray, as C, one core", ylabel="RMS error on the film, um")
        axis.set_xlim(0.5, 100)
        plain_log_ticks(axis.xaxis, axis.yaxis)
        axis.grid()

    table = [[title, *(found[method][at[name]] for name in at)] for method, (title, _) in METHODS.items()]
    ours, theirs = figure_of("ols-64", "RMS um"), figure_of("schrade-40", "RMS um")
    return Answer(
        "methods",
        "How does it compare with published methods?",
        f"a published polynomial leaves {short(theirs / ours)} times our error",
        f"Our polynomial leaves {short(ours)} um on the film at {short(figure_of('ols-64', 'fused ns/ray'))} ns a ray; "
        f"the best sparse polynomial that was published before leaves {short(theirs)} um at "
        f"{short(figure_of('schrade-40', 'fused ns/ray'))} ns. The published methods test one opening of the lens or "
        f"two, so that a rim in between blocks {span(passed)}% of the rays that they pass.",
        "Error on the film against time as C: ours are blue, published methods orange, renderers' own lenses grey.",
        draw,
        "method|RMS um|ns a ray as C|wrongly passed, %",
        table,
        [("python -m experiments surrogates laikin_double_gauss_50", "surrogates/laikin_double_gauss_50.md")],
        "One lens, the 50 mm f/1.8 double Gauss, at full aperture and field. The published methods are our "
        "implementations of [their papers](../papers.md), fitted on the same rays and written by the same writers. "
        "POTA and lentil, plug-ins of Arnold, are after Schrade 2016. The tables of rays were meant for a GPU and are "
        "judged on a CPU here. Each method has terms for the transmittance of the coated lens, which the papers lack. "
        "We did not run two models of 2026, of which their authors state figures for other lenses. Precomputed "
        "lens transport maps draw flare in 74.4 s, where tracing takes 1,180 s. Ray2Ray leaves about 1 um and 0.01 "
        "degrees. " + MACHINE,
        [
            (
                "experiments/results/surrogates/ogawa_zoom_70_200.md",
                "the same through a 70-200 zoom of bare glass, by an earlier state of our models",
            ),
            (
                "experiments/results/surrogates/phone_lens_6.md",
                "the same through a phone lens of bare glass, by an earlier state of our models",
            ),
            ("experiments/results/library/summary.md", "two methods over the whole library"),
        ],
    )


# ---- Time. -----------------------------------------------------------------------------------------------------------


def as_c(refractions: int) -> tuple[float, float, float]:
    """Nanoseconds of the exact lens as C, of the fastest model within 1 um, and that model's error."""
    rows = [r for r in results("fused_speed")["rows"] if r["refractions"] == refractions and r["work"] == "whole"]
    exact = next(r for r in rows if r["name"] == "exact C")
    tried = [r for r in rows if re.fullmatch(r"(ols|mlp)-\w+, C", r["name"]) and r["rms_um"] <= 1]
    best = min(tried, key=lambda r: r["ns"]["min"])
    return exact["ns"]["min"], best["ns"]["min"], best["rms_um"]


def by_hand(refractions: int) -> float:
    """Nanoseconds of the tracer written by hand, at its best: bare glass, mean polarisation; rims and status alike."""
    rows = results("tracer_race")["rows"]
    return float(
        min(r["ns"]["min"] for r in rows if r["refractions"] == refractions and r["name"].startswith("by hand"))
    )


def on_the_gpu(refractions: int, form: str) -> float:
    """Nanoseconds a ray made in place on the GPU, in the language that is fastest there."""
    found = results("gpu_day")
    lens = next(r["lens"] for r in found["rows"] if r["refractions"] == refractions)
    kinds = (r for r in found["rows"] if r["lens"] == lens and r["kind"] == "lens" and r["form"].split(",")[0] == form)
    shaders = (r["ns"]["in place"][0] for r in found["shaders"] if r["lens"] == lens and r["form"] == form)
    return min(*(1e9 * min(r["seconds"]["in place"]) for r in kinds), *shaders)


def speed() -> Answer:
    counts = (2, 7, 12, 33)
    core = {k: as_c(k) for k in counts}
    card = {
        k: (on_the_gpu(k, "exact"), on_the_gpu(k, form), form)
        for k, form in ((2, "ols-64"), (12, "ols-36"), (33, "ols-64"), (56, "ols-64"))
    }
    gains = {k: exact / model for k, (exact, model, _) in core.items()}
    hand = {k: by_hand(k) / core[k][1] for k in (2, 12, 33)}
    rows = results("gpu_day")["rows"]
    off = {(r["refractions"], r["form"]): r["rms_um"] for r in rows if r["kind"] == "lens" and r.get("rms_um")}
    gpu_gains = {k: exact / model for k, (exact, model, _) in card.items()}

    def draw(figure: Any) -> None:
        axis = figure.subplots()
        axis.plot(list(gains), list(gains.values()), "o-", color=BLUE, label="C on one core, beside our exact lens")
        axis.plot(list(hand), list(hand.values()), "o:", color=BLUE, label="the same, beside a tracer by hand")
        axis.plot(
            list(gpu_gains), list(gpu_gains.values()), "s-", color=GREEN, label="an H200 GPU, beside our exact lens"
        )
        axis.axhline(1, color=GREY, linestyle="--", label="exact tracing")
        axis.set(
            xscale="log",
            yscale="log",
            xlabel="refractions of the lens",
            ylabel="a model is so many times as fast",
        )
        plain_log_ticks(axis.xaxis, axis.yaxis)
        axis.legend()
        axis.grid()

    table = [
        *([f"C, {k} refractions", short(a, 3), short(b, 3), short(a / b), short(e)] for k, (a, b, e) in core.items()),
        *(
            [f"H200, {k} refractions", short(a), short(b), short(a / b), short(off[k, form])]
            for k, (a, b, form) in card.items()
            if k in (2, 12, 33)
        ),
    ]
    return Answer(
        "speed",
        "Where does a model pay?",
        "from 7 refractions on, in your own C or shader",
        f"As C on one core, a model within 1 um takes {short(core[12][1])} ns a ray through 12 refractions and is "
        f"{short(gains[12])} times as fast as our exact lens and {short(hand[12])} times as fast as a tracer written "
        f"by hand. On a GPU it gains {short(gpu_gains[12])} and {short(gpu_gains[33])} times at 12 and "
        "33 refractions and loses at 2; in our own renderer the exact lens costs so little that no model pays.",
        "How many times as fast as exact tracing a model is, by the lens's refractions.",
        draw,
        "where|exact, ns a ray|model, ns a ray|gain|model, RMS um",
        table,
        [("python -m experiments fused", "fused_speed.md"), ("python -m experiments gpu-day", "gpu_day.md")],
        f"Beside the tracer written by hand, a model is {short(hand[2])} times as fast at 2 refractions and "
        f"{short(hand[33])} times at 33. Rays are complete: stop, rims, transmittance and status, in float32. Glass is "
        "coated, but for the tracer written by hand and the GPU, where it is bare. Times are the best of 20 rounds. "
        + MACHINE,
        [
            (
                "experiments/results/tracer_race.md",
                "the exact lens as C beside a tracer written by hand: `python -m experiments tracer`",
            ),
            ("experiments/results/gpu_day.md", "whole cameras, gradients and other programs on that GPU"),
            ("models/README.md", "the speed of every model that ships"),
        ],
    )


def peers() -> Answer:
    rows = {
        f"{r['name']}|{r['precision']}": r
        for r in results("rays")["rows"]
        if r["lens"] == "laikin_double_gauss_50" and r.get("ns")
    }
    shown = {
        "ols-36, C|float32": ("ours, polynomial as C", BLUE),
        "C|float32": ("ours, exact as C", BLUE),
        "C, with dispersion and transmittance|float32": ("ours, exact, with transmittance", BLUE),
        "by hand, AVX, 3 vectors|float32": ("by hand in AVX, with transmittance", GREY),
        "torch|float32": ("ours, exact in torch", BLUE),
        "pbrt-v3, realistic camera|float32": ("pbrt-v3, realistic camera", ORANGE),
        "Optiland, numpy|float64": ("Optiland 0.6.3", ORANGE),
        "DeepLens|float32": ("DeepLens 2.5.6", ORANGE),
        "ray-optics|float64": ("ray-optics 0.9.8", ORANGE),
    }
    times = [rows[key]["ns"]["min"] for key in shown]

    def draw(figure: Any) -> None:
        axis = figure.subplots()
        bars(
            axis,
            [name for name, _ in shown.values()],
            times,
            [colour for _, colour in shown.values()],
            "ns a ray, one thread",
            digits=3,
        )
        axis.set(xscale="log", xlim=(1, 2e6))
        plain_log_ticks(axis.xaxis)

    table = [
        [name, key.partition("|")[2], short(rows[key]["ns"]["min"], 3), short(rows[key]["errors"]["film_um"])]
        for key, (name, _) in shown.items()
        if not key.startswith(("by hand", "C, with"))
    ]
    exact, best = (
        rows["C|float32"]["ns"]["min"],
        min(t for t, (_, c) in zip(times, shown.values(), strict=True) if c == ORANGE),
    )
    whole = rows["C, with dispersion and transmittance|float32"]["ns"]["min"]
    hand = rows["by hand, AVX, 3 vectors|float32"]["ns"]["min"]
    off = max(rows[key]["errors"]["film_um"] for key in rows if rows[key]["family"] != "model, ours")
    return Answer(
        "peers",
        "How does it compare with other programs?",
        f"exact rays {short(best / exact)} times as fast as the next program",
        f"On the same 100,000 rays our exact lens as C takes {short(exact)} ns a ray and the fastest other program "
        f"{short(best, 3)} ns ({short(best / exact)} times as long); all agree on the film within {short(off)} um. "
        f"With transmittance our lens takes {short(whole)} ns, while a tracer written by hand in AVX for this one lens "
        f"takes {short(hand)} ns, since it averages the polarisation that ours follows.",
        "Time of one ray through the 50 mm f/1.8 double Gauss, each program at its fastest setting.",
        draw,
        "program|precision|ns a ray|RMS um on the film",
        table,
        [("python -m experiments rays", "rays.md")],
        "All programs take the same film and pupil points on one thread. The error is against our tracer in float64. "
        + MACHINE,
        [
            ("docs/pages/results/flare.md", "ghosts beside flaresim"),
            ("experiments/results/gpu_day.md", "the same programs on a GPU: `python -m experiments gpu-day`"),
            (
                "experiments/results/collection.md",
                "agreement with ray-optics on 1,190 files: `python -m experiments collection FOLDER`",
            ),
            ("experiments/results/render_speed.md", "our renderer beside Mitsuba 3: `python -m experiments mitsuba`"),
            ("experiments/results/blender/README.md", "lenses in Cycles beside its own depth of field"),
        ],
    )


# ---- Truth. ----------------------------------------------------------------------------------------------------------


def tracer() -> Answer:
    rows, cases, wild = results("precision"), results("extremes"), results("wild")["rows"]
    read = results("collection")["verdicts"]["read"]
    agree = re.search(r"(\d+) agree within", (lab.RESULTS / "collection.md").read_text(encoding="utf-8"))
    assert agree is not None
    groups = {"aspheres": [r for r in rows if r["aspheres"]], "spheres alone": [r for r in rows if not r["aspheres"]]}
    worst = max(r["p99_um"] for r in rows)
    asked, off = sum(r["exact_rays"] for r in cases), max(r["exact_mm"] or 0 for r in cases)

    def draw(figure: Any) -> None:
        axis = figure.subplots()
        for colour, (name, some) in zip((ORANGE, BLUE), groups.items(), strict=True):
            curve(axis, [r["p99_um"] for r in some], f"{len(some)} lenses with {name}", colour)
        axis.axhline(PIXEL_UM, color=GREY, linestyle="--", label="a pixel of 5 um")
        axis.set(yscale="log", xlabel="share of the lenses with at most this error, %")
        axis.set_ylabel("error of float32 on the film, um\n(99% of a lens's rays have less)")
        plain_log_ticks(axis.yaxis)
        axis.legend()
        axis.grid()

    table = [
        [
            "ray-optics 0.9.8, whole files",
            f"{read:,} files",
            f"{int(agree[1]):,} within 1e-4",
            "each of the others has a named cause",
        ],
        ["50 digits, at the extremes", f"{asked:,} rays", f"{off * 1e6:.1g} nm", "worst distance"],
        ["float32 beside float64", f"{len(rows)} lenses", f"{short(worst)} um", "99th percentile, worst lens"],
        [
            "float32 at the extremes",
            f"{len(cases)} cases",
            str(sum(r["beyond"] for r in cases)),
            "statuses that differ away from edges",
        ],
        [
            "wild numbers, all languages",
            f"{sum(r['rays'] for r in wild) / 1e6:.0f} million rays",
            str(sum(r["wrong"] + r["not_finite"] for r in wild)),
            "wrong statuses or NaN that pass",
        ],
    ]
    return Answer(
        "tracer",
        "Is the exact tracer right?",
        f"99% of rays in float32 within {short(worst)} um on the film",
        f"Of {read:,} public lens files {int(agree[1]):,} agree with ray-optics within 1e-4 in focal length, image "
        "plane and chief rays, and each of the others differs by something that ray-optics is known to leave out. "
        f"Float64 stays within {off * 1e6:.1g} nm of 50 digits; float32, which cameras use, stays within "
        f"{short(worst)} um of float64 on the film (99th percentile of the rays, worst of {len(rows)} lenses).",
        "Float32 beside float64 on the film, for every lens file, from the best lens to the worst.",
        draw,
        "held against|cases|found|what it is",
        table,
        [
            ("python -m experiments collection FOLDER", "collection.md"),
            ("python -m experiments precision", "precision.md"),
            ("python -m experiments extremes", "extremes.md"),
            ("python -m experiments wild", "wild.md"),
        ],
        "The extremes are f/0.6 to f/45, a field of 220 degrees, grazing rays, total reflection, 380 and 780 nm and "
        "steep aspheres.",
        [
            ("experiments/results/transmittance.md", "what averaging over polarisation would cost"),
            ("experiments/results/passage.md", "the share of camera rays that pass the lens"),
            ("experiments/results/survive.md", "commands killed at random moments"),
            ("experiments/results/fuzz.md", "100,000 damaged files and command lines"),
        ],
    )


def lens_files() -> Answer:
    rows = [r for r in results("photographs")["rows"] if r["match"] == "certain" and r["distortion"] is not None]
    groups = {"primes": [r for r in rows if not r["zoom"]], "zooms": [r for r in rows if r["zoom"]]}
    every = [r for r in results("photographs")["rows"] if not r["zoom"]]
    found = {
        "shape of the distortion, %": [r["distortion"] for r in groups["primes"]],
        "shape of the distortion, zooms, %": [r["distortion"] for r in groups["zooms"]],
        "light near f/8, stops": [r["f8"] for r in every if r.get("f8") is not None],
        "light wide open, stops": [r["widest"] for r in every if r.get("widest") is not None],
        "the same, rims fitted to photographs": [r["fitted"][0][2] for r in every if r.get("fitted")],
    }
    library = results("photographs_library")["figures"]
    for kind in ("primes", "zooms"):
        found[f"this library, shape of the distortion, {kind}, %"] = library[kind]["distortion_percent"]
    itself = statistics.median([r["itself"] for r in groups["primes"] if r["itself"] is not None])

    def draw(figure: Any) -> None:
        axis = figure.subplots()
        for colour, (name, some) in zip((BLUE, ORANGE), groups.items(), strict=True):
            curve(axis, [r["distortion"] for r in some], f"{len(some)} {name}: file beside photographs", colour)
            itself = [r["itself"] for r in some if r["itself"]]
            axis.plot(
                [100 * (k + 1) / len(itself) for k in range(len(itself))],
                sorted(itself),
                ":",
                color=colour,
                label=f"{name}: the distortion itself",
            )
        axis.set(
            yscale="log", xlabel="share of the lenses with at most this, %", ylabel="distortion, % of the image height"
        )
        plain_log_ticks(axis.yaxis)
        axis.legend()
        axis.grid()

    def tenth(values: Sequence[float], part: float) -> float:
        ordered = sorted(values)
        return ordered[min(int(part * len(ordered)), len(ordered) - 1)]

    table = [[name, str(len(v)), short(statistics.median(v)), short(tenth(v, 0.9))] for name, v in found.items()]
    shape = found["shape of the distortion, %"]
    return Answer(
        "lens-files",
        "How right is a lens file?",
        f"distortion within {short(statistics.median(shape))}% (median of primes)",
        f"Beside photographs of {len(shape)} primes, the shape of the distortion is right within "
        f"{short(statistics.median(shape))}% of the image height (median; 90% within {short(tenth(shape, 0.9))}%), "
        f"where the distortion itself has a median of {short(itself)}%. Wide open the light is off by "
        f"{short(statistics.median(found['light wide open, stops']))} stops (median), because patents do not state "
        f"rims, and by {short(statistics.median(found['the same, rims fitted to photographs']))} stops with rims "
        "fitted to the photographs.",
        "Distortion of lens files beside that of photographs, from the best lens to the worst.",
        draw,
        "what|lenses|median|90% have less than",
        table,
        [
            ("python -m experiments photographs FOLDER", "photographs.md"),
            ("python -m experiments photographs lenses", "photographs_library.md"),
        ],
        "The photographs are those behind lensfun's profiles. The lens files are Zemax files of a public collection, "
        "OpticsDatabase; this library has no lens that its photographs contradict. Differences are root mean squares "
        "over image heights.",
        [
            ("experiments/results/faults.md", "tables broken on purpose, and whether that is seen"),
            ("experiments/results/alarms.md", "alarms on tables as they are"),
            ("docs/pages/how-to/photographs.md", "hold a lens against photographs yourself: `neurolens verify`"),
        ],
    )


# ---- Pictures. -------------------------------------------------------------------------------------------------------


def dispersion() -> Answer:
    rows = results("dispersion")["rows"]
    kinds = {"four": "four wavelengths", "lateral": "lateral colour alone"}

    def gains(kind: str, key: str) -> list[float]:
        return [r[kind][key] for r in rows]

    def draw(figure: Any) -> None:
        axis = figure.subplots()
        values = {
            "colour channels": gains("four", "gain_channels"),
            "luminance": gains("four", "gain"),
            "colour channels, lateral alone": gains("lateral", "gain_channels"),
            "luminance, lateral alone": gains("lateral", "gain"),
        }
        for k, (colour, some) in enumerate(zip((BLUE, BLUE, ORANGE, ORANGE), values.values(), strict=True)):
            axis.plot(some, [k] * len(some), "o", color=colour, alpha=0.6)
            axis.plot(statistics.median(some), k, "|", color="black", markersize=22)
        axis.set_yticks(range(len(values)), values)
        axis.axvline(1, color=GREY, linestyle="--")
        axis.invert_yaxis()
        axis.set(
            xscale="log", ylim=(3.6, -0.6), xlabel="times as fast to equal noise as one wavelength a path (bar: median)"
        )
        plain_log_ticks(axis.xaxis)
        axis.grid(axis="x")

    def line(name: str, values: Sequence[float]) -> list[str]:
        return [name, short(statistics.median(values)), short(min(values)), short(max(values))]

    table = [
        line("noise of luminance, one wavelength", [r["one"]["mean"] for r in rows]),
        line("noise of luminance, four wavelengths", [r["four"]["mean"] for r in rows]),
        line("noise of luminance, lateral colour alone", [r["lateral"]["mean"] for r in rows]),
        *(
            line(f"gain in {what}, {name}", gains(kind, key))
            for kind, name in kinds.items()
            for what, key in (("colour channels", "gain_channels"), ("luminance", "gain"))
        ),
    ]
    return Answer(
        "dispersion",
        "How noisy is dispersion?",
        f"equal noise {span(gains('four', 'gain_channels'))} times sooner",
        "Paths of four wavelengths, each from its own film point, reach equal noise in the colour channels "
        f"{span(gains('four', 'gain_channels'))} times as fast as paths of one wavelength (median "
        f"{short(statistics.median(gains('four', 'gain_channels')))}). Their luminance has "
        f"{span([r['four']['mean'] for r in rows])} times the variance of a thin lens, which has no dispersion.",
        "Gain of four wavelengths a path over one, a dot for each of three scenes and six lenses.",
        draw,
        "what|median|least|most",
        table,
        [("python -m experiments dispersion", "dispersion.md")],
        "Noise is the variance over that of a thin lens. A gain is the ratio of the times to equal variance. "
        "*Lateral colour alone* is `--dispersion lateral`, without longitudinal colour. Three scenes "
        "through six exact lenses as C, 16 samples a pixel, one thread. " + MACHINE,
        [
            (
                "experiments/results/osl_noise.md",
                "the same question in Blender's Cycles: `python -m experiments osl-noise`",
            ),
            ("experiments/results/render_times/README.md", "what a camera adds to a picture's time"),
        ],
    )


def pictures() -> Answer:
    scenes = results("equal_time")["scenes"]
    titles = {
        "fused exact": ("exact, as C", BLUE),
        "fused mlp-16x2": ("network, as C", GREEN),
        "ols-28": ("polynomial, onnxruntime", ORANGE),
        "thin lens": ("thin lens", GREY),
    }

    def camera(scene: Any, name: str) -> Any:
        return next(c for c in scene["cameras"] if c["name"] == name)

    def draw(figure: Any) -> None:
        for axis, scene in zip(figure.subplots(1, len(scenes), sharey=True), scenes, strict=True):
            for name, (title, colour) in titles.items():
                levels = camera(scene, name)["levels"]
                axis.plot(
                    [r["seconds_min"] for r in levels],
                    [100 * r["rel_mse"] ** 0.5 for r in levels],
                    "o-",
                    color=colour,
                    label=title,
                    markersize=3,
                )
            axis.set(xscale="log", yscale="log", xlabel="seconds", title=scene["scene"])
            plain_log_ticks(axis.xaxis, axis.yaxis)
            axis.grid()
        figure.axes[0].set_ylabel("relative error of the picture, %")
        figure.axes[-1].legend()

    table = [
        [title, *(short(camera(scene, name)["flip_paired"]) for scene in scenes)] for name, (title, _) in titles.items()
    ]
    thin = [camera(s, "thin lens")["flip_paired"] for s in scenes]
    net = [camera(s, "fused mlp-16x2")["flip_paired"] for s in scenes]
    times = [min(camera(s, "fused exact")["pass_s"]) / min(camera(s, "thin lens")["pass_s"]) for s in scenes]
    saved = [1 - min(camera(s, "fused mlp-16x2")["pass_s"]) / min(camera(s, "fused exact")["pass_s"]) for s in scenes]
    return Answer(
        "pictures",
        "What does a real lens cost in a picture?",
        f"{span(times)} times the time of a thin lens",
        f"In our renderer a picture through the exact lens as C takes {span(times)} times as long as one through a "
        f"thin lens, which stays wrong by a FLIP of {span(thin)} however long it runs. A picture through a network "
        f"is wrong by {span(net)} and takes at most {share(max(saved))} less time: use the exact lens here.",
        "Error against seconds: the thin lens stops where its picture is wrong.",
        draw,
        "camera, FLIP of its picture|" + "|".join(s["scene"] for s in scenes),
        table,
        [
            ("python -m experiments equal-time", "equal_time.md"),
            ("python -m experiments render", "render_times/README.md"),
        ],
        "The 50 mm f/1.8 double Gauss, 160 x 90 pixels, one wavelength a path, against 4,096 samples a pixel. FLIP "
        "compares mean pictures of the same random numbers. " + MACHINE,
        [
            (
                "experiments/results/gallery/README.md",
                "twenty-two effects of real lenses, each measured: `python -m experiments gallery`",
            ),
            ("experiments/results/plans.md", "plans of scenes, and whether they hold: `python -m experiments plans`"),
            ("experiments/results/dask.md", "a farm of workers: `python -m experiments dask`"),
        ],
    )


# Labels that would cover others are moved by so many points, right and up.
PLACES = {"garden": (-14, -12), "studio": (5, -11), "lamps": (-34, -3), "chess": (5, 5), "lights": (6, -8)}


def blur() -> Answer:
    rows = results("defocus")["rows"]
    flips, thin = [r["flip"] for r in rows], [r["flip_thin"] for r in rows]

    def draw(figure: Any) -> None:
        axis = figure.subplots()
        for colour, kind, name in (
            (BLUE, ("cpu_s", "flip"), "plate blurred by defocus"),
            (GREY, ("render_cpu_s", "flip_thin"), "thin lens, path-traced"),
        ):
            axis.plot([r[kind[0]] for r in rows], [r[kind[1]] for r in rows], "o", color=colour, label=name)
            for row in rows:
                place = row[kind[0]], row[kind[1]]
                axis.annotate(
                    row["scene"], place, PLACES.get(row["scene"], (5, 3)), textcoords="offset points", fontsize=8.5
                )
        axis.set(
            xscale="log",
            xlim=(0.2, 1000),
            ylim=(0, 0.36),
            xlabel="CPU seconds",
            ylabel="FLIP from the path-traced lens",
        )
        plain_log_ticks(axis.xaxis)
        axis.legend(loc="upper center")
        axis.grid()

    table = [
        [r["scene"], short(r["flip"]), short(r["flip_thin"]), short(r["cpu_s"]), short(r["render_cpu_s"], 3)]
        for r in rows
    ]
    return Answer(
        "blur",
        "How close is the blur of a plate?",
        f"FLIP {span(flips)} from the path-traced lens",
        "A sharp plate with depth, blurred by `neurolens defocus`, differs from a path-traced picture through the same "
        f"lens by a FLIP of {span(flips)}; a path-traced thin lens differs by {span(thin)}. `defocus` takes "
        f"{span([r['cpu_s'] for r in rows])} CPU seconds, and the path tracer "
        f"{span([r['render_cpu_s'] for r in rows], 3)}.",
        "FLIP from the path-traced lens against CPU time, six scenes.",
        draw,
        "scene|FLIP, `defocus`|FLIP, thin lens|CPU s, `defocus`|CPU s, path tracer",
        table,
        [
            ("python -m experiments defocus", "defocus.md"),
            ("python -m experiments defocus --checks", "defocus_checks.md"),
        ],
        "A 50 mm f/1.4 wide open, pictures 480 pixels wide. Plates have 512 samples a pixel, path-traced pictures "
        "1,024. `defocus` took its default of 128 samples. Other programs shared the machine, so times are upper "
        "bounds. " + MACHINE,
        [("docs/pages/how-to/defocus.md", "blur a plate yourself")],
    )


def blender() -> Answer:
    rows = {r["camera"]: r for r in results("osl_speed")["rows"] if r["scene"] == "sky"}
    rooms = {r["camera"]: r for r in results("osl_speed")["rows"] if r["scene"] == "room"}
    shown = {
        "thin lens in OSL": ("thin lens in OSL", GREY),
        "ols-36": ("polynomial, 12 refractions", BLUE),
        "mlp-10x1": ("network, 12 refractions", BLUE),
        "ols-64 of 33 refractions": ("polynomial, 33 refractions", BLUE),
        "exact, 12 refractions": ("exact, 12 refractions", ORANGE),
        "exact, 33 refractions": ("exact, 33 refractions", ORANGE),
    }

    def draw(figure: Any) -> None:
        axis = figure.subplots()
        bars(
            axis,
            [name for name, _ in shown.values()],
            [rows[key]["over"] for key in shown],
            [colour for _, colour in shown.values()],
            "time of a camera ray over a thin lens in OSL",
        )

    table = [
        [name, short(rows[key]["over"]), "\u2013" if rows[key]["error_um"] is None else short(rows[key]["error_um"])]
        for key, (name, _) in shown.items()
    ]
    return Answer(
        "blender",
        "What does a lens cost in Blender?",
        f"a camera ray takes {short(rows['ols-36']['over'])} times a thin lens's",
        f"In Cycles a camera ray through a model takes {short(rows['ols-36']['over'])} times as long as through a "
        f"thin lens in OSL; through an exact lens it takes {short(rows['exact, 12 refractions']['over'])} times as "
        f"long at 12 refractions and {short(rows['exact, 33 refractions']['over'])} at 33. A whole picture of a room "
        f"takes {short(rooms['ols-36']['over'], 3)} times as long as with Cycles's own depth of field, and "
        f"{short(rooms['ols-36, one colour']['over'], 3)} times with dispersion off.",
        "Time of one camera ray in Cycles over that through a thin lens in OSL, before a white sky.",
        draw,
        "camera|time over a thin lens|RMS um on the film",
        table,
        [
            ("python -m experiments osl --blender-python PYTHON", "osl_speed.md"),
            ("python -m experiments osl-noise", "osl_noise.md"),
        ],
        "Blender " + results("osl_speed")["blender"] + " as a module. " + MACHINE,
        [
            ("experiments/results/osl_passing.md", "the share of the samples that pass the lens, for all 192 shaders"),
            ("experiments/results/blender/README.md", "six lenses in Cycles beside its own depth of field"),
            ("docs/pages/how-to/blender.md", "a lens in Blender"),
        ],
    )


LENSES = {
    "laikin_double_gauss_50": "double Gauss",
    "brendel_tessar_100": "Tessar",
    "ikemori_retrofocus_14": "retrofocus",
    "ogawa_zoom_70_200": "zoom",
    "phone_lens_6": "phone lens",
}


def flare() -> Answer:
    rows = results("flare_speed")["rows"]
    stars, glare = results("starburst")["checks"], results("glare")["contrast"]
    ring = max(abs(c["found"] / c["right"] - 1) for c in stars if "ring" in c["what"])
    veil = {r["coating"]: r["veil"] for r in glare if (r["condition"], r["surround"]) == ("clean", "all ahead")}
    beside = next(r for r in results("flare_speed")["beside"] if r["tracer"].startswith("flaresim"))["ns_min"]
    photons = results("photons")["rows"]
    times = [r["seconds"] for r in photons]
    names = [f"{LENSES[r['lens']]}, {r['surfaces']} surfaces" for r in rows]

    def draw(figure: Any) -> None:
        axis = figure.subplots()
        bars(
            axis,
            [*names, "flaresim, double Gauss"],
            [*(r["compiled_min"] for r in rows), beside],
            [BLUE] * len(rows) + [ORANGE],
            "ns a ghost ray, one core",
            digits=3,
        )

    own = [r["compiled_min"] for r in rows]
    table = [
        ["ghost ray, ns", span(own), short(beside, 3), "flaresim, on the first lens"],
        ["ten million photons, s", span(times), "7,867 to 9,017", "Keshmirian 2008, his machine"],
        ["first dark ring of a star", share(ring), "0", "worst difference from Airy's ring"],
        *(
            [f"veil of a double Gauss, {coating}", share(value), "\u2013", "share of white, all ahead bright"]
            for coating, value in veil.items()
        ),
    ]
    return Answer(
        "flare",
        "How fast and how right is flare?",
        f"{span(own)} ns a ghost ray",
        f"Through five lenses a ghost ray takes {span(own)} ns on one core; flaresim, a public tracer, takes "
        f"{short(beside, 3)} ns through the first of them. The first dark ring of a star lies within "
        f"{share(ring)} of Airy's, and ten million photons through a zoom take {span(times)} s.",
        "Time of one ray of one pair of reflections at one wavelength.",
        draw,
        "what|ours|other|what the other is",
        table,
        [
            ("python -m experiments flare", "flare_speed.md"),
            ("python -m experiments photons", "photons.md"),
            ("python -m experiments starburst", "starburst.md"),
            ("python -m experiments glare", "glare.md"),
        ],
        MACHINE,
        [
            ("experiments/results/flare/README.md", "pictures: suns, headlights, coatings, stops"),
            ("docs/pages/how-to/flare.md", "flare for a picture of yours"),
        ],
    )


# ---- All of them. ----------------------------------------------------------------------------------------------------

ANSWERS = (models, methods, speed, peers, tracer, lens_files, pictures, dispersion, blur, blender, flare)
_MARKS = "<!-- answers -->", "<!-- end of answers -->"


def index(text: str, answers: Sequence[Answer]) -> str:
    """The list of all questions, put between its marks in the page of results."""
    start, end = (text.index(mark) for mark in _MARKS)
    table = lab.table("question|answer", [[f"[{a.question}](results/{a.name}.md)", a.short] for a in answers])
    return f"{text[:start]}{_MARKS[0]}\n{table}\n{text[end:]}"


OPTIONS = (lab.QUIET,)


def run(args: argparse.Namespace) -> None:
    """Write every page and its plot, and the list of them."""
    answers = [make() for make in ANSWERS]
    for answer in lab.counted(answers, "pages", args.quiet):
        with drawing(PAGES / "results" / f"{answer.name}.png", 7.5, 3.9) as figure:
            figure.get_layout_engine().set(w_pad=0.12, h_pad=0.1)
            answer.draw(figure)
        atomic_write_text(PAGES / "results" / f"{answer.name}.md", answer.page())
    atomic_write_text(PAGES / "results.md", index((PAGES / "results.md").read_text(encoding="utf-8"), answers))
