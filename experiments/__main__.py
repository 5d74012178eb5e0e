"""`python -m experiments NAME`: the measurements behind the README's tables, the gallery, and the models that ship.

Run from the project's folder. Each folder beside this file asks one question, which its docstring states. A measurement
is a module there with `OPTIONS` and `run`, and its docstring is the help; see `lab`. A second measurement PART of a
module has `PART_OPTIONS` and `run_part`, whose docstring is its help. Data stay outside the folders: scenes/, lenses/,
fuzz_seeds/, the effects of gallery/, and what was measured in results/.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Sequence
from importlib import import_module

from neurolens import cli
from neurolens.cli.arguments import Parser

QUESTIONS = {
    "accuracy": {
        "surrogates": ("surrogates", "all methods on a set of lenses, or on the whole library"),
        "vignetting": ("vignetting", "false passes and blocks, illumination"),
        "clipping": (
            "vignetting:clipping",
            "rays that shipped models pass or block wrongly, networks beside polynomials",
        ),
        "precision": ("precision", "rays in float32 beside float64, through every lens file"),
        "extremes": ("extremes", "errors and statuses at the ends of what optics allows"),
        "inverse": ("inverse", "inverse maps: how often they arrive"),
        "phase": ("phase", "the optical path of models, and point spread from it, beside exact rays"),
        "zoom": ("zoom", "models of whole zooms, of internal focus"),
        "shots": ("shots", "models fitted to one shot beside those that ship: error, operations, time"),
        "pupils": ("pupils", "share of rays that pass a lens of those sent through its outlines"),
        "copies": ("copies", "copies of lenses by models beside the exact trace: spots, MTF, time"),
        "transmittance": ("transmittance", "what averaging over polarisation at every surface would cost"),
    },
    "speed": {
        "fused": ("fused_speed", "models as C against the exact lens as C"),
        "tracer": ("tracer_race", "the exact lens as C beside a tracer written by hand"),
        "gpu": ("gpu", "lenses and models as GLSL compute shaders, on a GPU or by software OpenGL"),
        "gpu-day": ("gpu_day", "exact lenses, models and cameras on a GPU: CUDA C++, torch, shaders, gradients"),
        "promises": ("promises", "models against the speed that their index promises"),
        "flare": ("flare_speed", "ghosts: nanoseconds a ray, compiled and path by path"),
        "render": ("render_times", "render time by camera and scene"),
        "view": ("view_speed", "the page of `neurolens view` in software WebGL: first picture, each change"),
        "dask": ("cluster", "a Dask cluster: speed-up, overhead a task, 100,000 tasks by simulation"),
    },
    "hostile": {
        "fuzz": ("fuzz", "hostile files and command lines: one clear line each, in bounded time and memory"),
        "survive": ("survive", "commands killed at random moments end in the same result"),
        "wild": ("wild", "wild numbers in every language: equal statuses, no NaN"),
        "outside": ("outside", "random inputs through exported models"),
    },
    "pictures": {
        "deblur": ("deblur", "a network that corrects blur, trained on real lenses or on random Zernike terms"),
        "plans": ("plans", "plans of scenes: whether budgets are kept, and what the cheapest camera costs"),
        "plan-times": ("plan_times", "seconds that plans print beside those of renders to equal noise"),
        "equal-time": ("equal_time", "errors of pictures after equal time and equal samples, every camera"),
        "defocus": ("defocus", "the blur of a lens for sharp pictures, beside path-traced ones"),
        "dispersion": ("dispersion", "noise and time of lenses that disperse, beside a thin lens"),
        "glare": ("glare", "contrast that veiling glare takes"),
        "photons": ("photons", "flare by photons, as in Keshmirian 2008"),
        "starburst": ("starburst", "stars by diffraction: checks against closed forms, seconds"),
        "radiance": ("radiance", "a radiance field from photographs through a lens: pinhole, thin lens and lens"),
        "gallery": ("gallery.run", "what real lenses do: figures and numbers"),
        "four-lenses": ("four_lenses", "the README's first picture: a night through a thin lens and three real ones"),
        "flare-gallery": ("flare_gallery", "pictures of flare: suns, headlights, coatings, stops, an animation"),
        "usd-lights": ("usd_lights", "the lights of a USD stage as a list for `neurolens flare --lights`"),
    },
    "peers": {
        "rays": ("rays", "an open benchmark of lens rays: error and time, ours beside other programs"),
        "mitsuba": ("mitsuba_speed", "speed of the renderer beside Mitsuba 3"),
        "hosts": ("hosts", "one scene by the rays of `neurolens rays`: our renderer, Mitsuba 3, NVIDIA Newton"),
        "osl": ("osl_speed", "cameras in Blender's Cycles: shaders of models beside its own"),
        "osl-pictures": ("osl_speed:pictures", "lenses in Cycles beside its own depth of field"),
        "osl-noise": ("osl_noise", "noise of dispersion in Cycles, and what adaptive sampling takes"),
    },
    "data": {
        "models": ("make_models", "make the models that ship"),
        "lens-index": ("lens_index", "the index of lenses/: their data and character for `neurolens lens list`"),
        "library": ("library_pages", "a page for each lens, with every analysis drawn, and an index of all"),
        "collection": ("collection", "a public collection of lens files: read, refused, agreement with ray-optics"),
        "photographs": ("photographs", "that collection against photographs: distortion, colour, light, fitted rims"),
        "photographs-faults": ("photographs_faults", "lens tables broken on purpose: faults found, changes named"),
        "named-lenses": ("named_lenses", "write the lens files of real lenses by name from that collection"),
        "patent-lenses": ("patent_lenses", "write the lens files of real lenses by name from another collection"),
        "answers": ("answers", "write the pages of results from what measurements have written"),
    },
}
NAMES = {name: (f"{folder}.{module}", text) for folder, of in QUESTIONS.items() for name, (module, text) in of.items()}
_DESCRIPTION = """\
Measure on this machine what the README reports, and write tables to runs/results (--commit: experiments/results).
Needs the extra "train"; run it from the project's folder."""


def build_parser(argv: Sequence[str]) -> Parser:
    """The whole command line; only the measurement that `argv` names is imported."""
    width = max(map(len, NAMES))
    questions = []
    for folder, names in QUESTIONS.items():
        rows = [f"  {name:{width}}  {text}" for name, (_, text) in names.items()]
        questions.append("\n".join([f"{folder}: {inspect.getdoc(import_module(f'experiments.{folder}'))}", *rows]))
    parser = Parser(prog="python -m experiments", description=_DESCRIPTION, epilog="\n\n".join(questions))
    kinds = parser.add_subparsers(metavar="NAME", required=True, parser_class=Parser, help="a measurement, as below")
    for name, (module, _) in NAMES.items():
        chosen = kinds.add_parser(name)
        if argv[:1] == [name]:
            name, _, part = module.partition(":")
            found = import_module(f"experiments.{name}")
            run = getattr(found, f"run_{part}" if part else "run")
            chosen.description = inspect.getdoc(run if part else found)
            chosen.set_defaults(run=lambda args, run=run: run(args) or 0, kept="what was finished is kept")
            for add in getattr(found, f"{part.upper()}_OPTIONS" if part else "OPTIONS"):
                add(chosen)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one measurement and return its exit code, as `neurolens.cli.main` does."""
    given = sys.argv[1:] if argv is None else argv
    return cli.main(given, lambda: build_parser(given))


if __name__ == "__main__":
    sys.exit(main())
