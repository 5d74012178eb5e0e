"""A lens handed over: each file opens in the library that defines its format, and says where rays go.

The oracle of places are the analysis's chief rays through the prescription, which no file has seen, with the stop
nearly closed. Each file takes what they show to where the pinhole has it, within what README.md says that it leaves.
"""

from __future__ import annotations

import argparse
import ast
import json
import math
import re
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
import pytest

from neurolens.base.html import html
from neurolens.cameras import field as fields
from neurolens.cameras.build import make_camera
from neurolens.cameras.field import field_of, spectrum_of
from neurolens.cli import main
from neurolens.cli.handover import _rate, _Writer
from neurolens.models.card import read_card
from neurolens.optics.analysis.fields import Scene
from neurolens.optics.lens.paraxial import chief_reach_mm
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.any_format import read_any
from neurolens.optics.setting.focusing import best_focused
from neurolens.optics.setting.states import set_lens
from neurolens.pictures.render.pictures import read_channels, read_metadata
from neurolens.pictures.render.stmap import plates_of
from neurolens.programs import handover as files
from neurolens.programs.handover import Handed, Pinhole, falloff
from tests.command_line import failure, run_json

ROOT = Path(__file__).parents[3]
GAUSS = ROOT / "models" / "laikin_double_gauss_50.ols-60.onnx"
EXACT = ROOT / "lenses" / "laikin_double_gauss_50.toml"
WIDE, FILM, FOCUS_M = (480, 270), (36.0, 20.25), 2.0
PIXEL = FILM[0] / WIDE[0]
TRACED = 0.02  # pixels, of 75 um, between the chief rays and the model's centroids at f/22
SCHEMA = json.loads((ROOT / "tests" / "data" / "opentrackio.json").read_text(encoding="utf-8"))


class Case(NamedTuple):
    folder: Path
    told: dict[str, Any]
    camera: Any
    lens: dict[str, np.ndarray]  # by colour, "" for the eye's mean: where the lens shows points, x + i y in mm, y up
    pinhole: np.ndarray  # where the pinhole shows them

    def place(self, colour: str = "") -> tuple[np.ndarray, np.ndarray]:
        """Pixels x, y [N] from the centre of the upper left one: of the lens's picture, of the undistorted one."""
        found = []
        for size, point in ((WIDE, self.lens[colour]), (self.told["undistorted_px"], self.pinhole)):
            found.append(np.stack([point.real / PIXEL + size[0] / 2 - 0.5, size[1] / 2 - 0.5 - point.imag / PIXEL]))
        return found[0], found[1]

    @property
    def way(self) -> np.ndarray:
        """Directions [3, N] of the points from the pinhole: x right, y up, z forward, of which z is 1."""
        slope = self.pinhole / self.told["frames"][0]["focal_mm"][0]
        return np.stack([slope.real, slope.imag, np.ones(slope.size)])


def heights(lens: Any, nm: float, ideal_mm: np.ndarray, before_mm: float) -> np.ndarray:
    """Where chief rays of a wavelength show what the pinhole shows at these heights."""
    scene = Scene(lens, FOCUS_M)
    chief = scene.chief_rays(np.linspace(0.3, 25, 20), nm)
    across = scene.object_points(chief.start)[1 if scene.axis == "y" else 0]  # type: ignore[index]
    ideal = np.abs(across.numpy()) / (1e3 * FOCUS_M - before_mm) * chief_reach_mm(lens)
    height = np.abs(chief.height_mm.numpy())
    return ideal_mm * np.interp(ideal_mm, ideal, height / ideal)


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Case]:
    """A still at f/22 with maps by colour."""
    folder = tmp_path_factory.mktemp("handover") / "shot"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fields, "_ROUND", (97, 1))
        patch.setattr(files, "SIDE", 513)
        patch.setattr(files, "_SMALLER", ())
        told: list[dict[str, Any]] = []
        patch.setattr("neurolens.cli.arguments.print_json", told.append)
        words = ["handover", str(GAUSS), "--film", "36x20.25", "--size", "480x270", "--focus", "2", "--f-number", "22"]
        assert main([*words, "--lateral-colour", "-o", str(folder), "--json", "--quiet"]) == 0
    camera = make_camera(GAUSS, Shot(film_mm=FILM, focus_m=FOCUS_M, f_number=22.0))
    lens = best_focused(set_lens(read_any(EXACT), focus_m=FOCUS_M, f_number=22.0), FOCUS_M)
    radius = np.linspace(1, 20.4, 8)
    before = told[0]["frames"][0]["before_film_mm"][0]
    shown = {nm: heights(lens, nm, radius, before) for nm in (611.4, 464.2, *spectrum_of(camera)[0])}
    mean = np.average([shown[nm] for nm in spectrum_of(camera)[0]], axis=0, weights=spectrum_of(camera)[1])
    turn = np.exp(1j * np.array([[0.51], [2.6], [-0.45]]))  # towards corners
    by_name = {"": mean, "red": shown[611.4], "blue": shown[464.2]}
    yield Case(folder, told[0], camera, {k: (v * turn).ravel() for k, v in by_name.items()}, (radius * turn).ravel())


def read_at(plane: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Values of a plane between its pixels, x and y from the centre of the upper left one."""
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    found = np.zeros(x.shape)
    for right, down in ((0, 0), (0, 1), (1, 0), (1, 1)):
        weight = np.abs(1 - right - (x - column)) * np.abs(1 - down - (y - row))
        found += weight * plane[row + down, column + right]
    return found


def test_st_maps_take_what_rays_show_to_the_pinholes_and_back(case: Case) -> None:
    for colour in ("", "red", "blue"):
        lens, pinhole = case.place(colour)
        for kind, at, other, size in (
            ("undistort", pinhole, lens, WIDE),
            ("redistort", lens, pinhole, case.told["undistorted_px"]),
        ):
            name = f"shot.{kind}.{colour}.exr" if colour else f"shot.{kind}.exr"
            planes, _ = read_channels(case.folder / name)
            s, t = (read_at(planes[c], *at) for c in "RG")
            assert np.hypot(s * size[0] - 0.5 - other[0], (1 - t) * size[1] - 0.5 - other[1]).max() < TRACED
    assert (
        np.hypot(
            *(case.place()[0] - case.place()[1] + 0.5 * np.subtract(case.told["undistorted_px"], WIDE)[:, None])
        ).max()
        > 5
    )


def test_usd_opens_the_cameras_and_the_lookup_pictures(case: Case) -> None:
    pxr = pytest.importorskip("pxr", reason="usd-core (extra dev) is not installed")
    from pxr import Usd, UsdGeom  # noqa: F401

    stage = Usd.Stage.Open(str(case.folder / "shot.usda"))
    assert stage.GetDefaultPrim().GetPath() == "/Film" and UsdGeom.GetStageMetersPerUnit(stage) == 0.01
    state, row = case.camera.settings["lens_state"], case.told["frames"][0]
    for name, size in (("Lens", WIDE), ("Pinhole", case.told["undistorted_px"])):
        camera = UsdGeom.Camera(stage.GetPrimAtPath(f"/Film/{name}"))
        seen = camera.GetCamera(Usd.TimeCode.Default())
        assert seen.focalLength == pytest.approx(row["focal_mm"][0]) and seen.focusDistance == pytest.approx(
            200 - row["before_film_mm"][0] / 10
        )
        assert (seen.horizontalAperture, seen.verticalAperture) == pytest.approx((size[0] * PIXEL, size[1] * PIXEL))
        # The entrance pupil's diameter, by which discs have the lens's size.
        pupil = seen.focalLength / seen.fStop
        assert pupil == pytest.approx(state["effective_focal_length_mm"] / state["f_number"])
        assert camera.GetExposureFStopAttr().Get() == pytest.approx(state["t_stop"])
        place = UsdGeom.Xformable(camera).GetLocalTransformation().ExtractTranslation()
        assert list(place) == pytest.approx([0, 0, -row["before_film_mm"][0] / 10])
    prim = stage.GetPrimAtPath("/Film/Lens")
    assert prim.GetMetadata("apiSchemas").GetAddedOrExplicitItems() == ["OmniLensDistortionLutAPI"]
    lut = {a.GetBaseName(): a.Get() for a in prim.GetAuthoredAttributes() if "lut" in a.GetName()}
    assert (lut["nominalWidth"], lut["nominalHeight"], tuple(lut["opticalCenter"])) == (480, 270, (240, 135))
    assert prim.GetAttribute("omni:lensdistortion:model").Get() == "lut"
    enter, exits = (
        read_channels(lut[f"ray{name}Texture"].resolvedPath)[0] for name in ("EnterDirection", "ExitPosition")
    )
    way = case.way * [[1], [1], [-1]]
    way /= np.linalg.norm(way, axis=0)
    lens, _ = case.place()
    found = np.stack([read_at(enter[c], *lens) for c in "RGB"])
    assert np.abs(found - way).max() * row["focal_mm"][0] / PIXEL < TRACED
    # Folded onto an octahedron's square, forward in the middle, rows from y = -1 on.
    u, v = way[:2] / np.abs(way).sum(0)
    side = exits["R"].shape[0]
    place = [read_at(exits[c], *((k + 1) / 2 * side - 0.5 for k in (u, v))) for c in "RG"]
    wrong = np.hypot(place[0] * 480 - 0.5 - lens[0], place[1] * 270 - 0.5 - lens[1])
    assert wrong.max() < case.told["left"]["exit_px"] + TRACED
    assert pxr is not None


def test_opentrackio_samples_are_valid_and_their_formulas_undistort(case: Case) -> None:
    jsonschema = pytest.importorskip("jsonschema", reason="jsonschema (extra dev) is not installed")
    sample = json.loads((case.folder / "shot.opentrackio.json").read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    jsonschema.validate(sample, SCHEMA, cls=jsonschema.Draft202012Validator)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(sample | {"lens": sample["lens"] | {"tStop": "wide"}}, SCHEMA)
    lens, state = sample["lens"], case.camera.settings["lens_state"]
    assert (lens["fStop"], lens["tStop"], lens["focusDistance"]) == pytest.approx((22, state["t_stop"], 2))
    assert lens["entrancePupilOffset"] == pytest.approx(state["entrance_pupil_offset_mm"] / 1e3)
    assert sample["static"]["camera"]["activeSensorPhysicalDimensions"] == {"width": 36, "height": 20.25}
    both = case.lens[""], case.pinhole
    for told, (at, other) in zip(lens["distortion"], (both, both[::-1]), strict=True):
        k1, k2, k3, k4, k5, k6 = told["radial"]
        r2 = np.abs(at) ** 2
        moved = at * (1 + k1 * r2 + k3 * r2**2 + k5 * r2**3) / (1 + k2 * r2 + k4 * r2**2 + k6 * r2**3)
        assert np.abs(moved - other).max() / PIXEL < case.told["left"]["opentrackio_px"] + TRACED
        assert told["overscan"] == max(case.told["overscan"])
    assert [d["model"] for d in lens["distortion"]] == ["Brown-Conrady D-U", "Brown-Conrady U-D"]
    light, _ = read_channels(case.folder / "shot.illumination.exr")
    y, x = np.mgrid[:270:30, :480:30]
    r2 = ((x + 0.5 - 240) ** 2 + (y + 0.5 - 135) ** 2) * PIXEL**2
    a = lens["exposureFalloff"]
    formula = 1 - (a["a1"] * r2 + a["a2"] * r2**2 + a["a3"] * r2**3)
    assert np.abs(formula - light["R"][::30, ::30]).max() < case.told["left"]["light_share"] + 1e-3
    assert light["R"].min() < 0.9 and (light["A"] == 1).all()


def test_terms_of_a_wide_lens_s_distortion_do_not_cancel(monkeypatch: pytest.MonkeyPatch) -> None:
    """A ratio of two polynomials, which a reader with float32 evaluates as well, and of which none is near 0."""
    monkeypatch.setattr(fields, "_ROUND", (97, 1))
    camera = make_camera("fused:nikon_af_nikkor_20mm_f2_8d", Shot(film_mm=FILM, focus_m=FOCUS_M, f_number=4.0))
    field = field_of(camera, FOCUS_M)
    plates = plates_of([field], (3840, 2160), FILM)
    pinhole = Pinhole.of("", field, camera.settings, FOCUS_M)
    text, left_px, _ = files.opentrackio_sample(
        field, pinhole, Handed({"cameraModel": "x"}, "0", (24, 1), (pinhole,), plates, ())
    )
    r, found = np.linspace(0, 20.6, 100, dtype=np.float32), json.loads(text)["lens"]["distortion"]
    shown = field.directions(r.astype(complex))
    goal = pinhole.focal_mm * shown[0] / shown[2]
    for term, (start, end) in zip(found, ((r, goal), (goal.astype(np.float32), r)), strict=True):
        k = np.array(term["radial"], np.float32)
        above, below = (1 + sum(k[n + 2 * i] * start ** (2 * i + 2) for i in range(3)) for n in (0, 1))
        assert k[1] != 0 and min(above.min(), below.min()) > 0.3
        assert np.abs(start * above / below - end).max() / plates.pixel_mm[0] < left_px + 0.01 < 0.11


def test_lensfun_corrects_distortion_colour_and_light(case: Case) -> None:
    lensfunpy = pytest.importorskip("lensfunpy", reason="lensfunpy (extra dev) is not installed")
    database = lensfunpy.Database(paths=[str(case.folder / "shot.lensfun.xml")], load_common=False, load_bundled=False)
    [camera], [lens] = database.cameras, database.lenses
    assert database.find_lenses(camera, lens.maker, lens.model) and lens.model == "Double Gauss 50 mm f/1.8"
    flags, left = lensfunpy.ModifyFlags, case.told["left"]
    scale = float(re.search(r"`scale` ([\d.]+) of its", (case.folder / "README.md").read_text())[1])  # type: ignore[index]

    def modifier(kind: Any, f_number: float = 22.0, kinds: Any = np.uint8) -> Any:
        made = lensfunpy.Modifier(lens, camera.crop_factor, *WIDE)
        made.initialize(lens.min_focal, f_number, FOCUS_M, scale=scale, pixel_format=kinds, flags=kind)
        return made

    geometry = modifier(flags.DISTORTION | flags.SCALE | flags.TCA)
    margin = np.subtract(case.told["undistorted_px"], WIDE)[:, None] / 2
    where = geometry.apply_subpixel_geometry_distortion()  # [H, W, 3, 2]
    for channel, colour in ((0, "red"), (2, "blue")):
        shown, pinhole = case.place(colour)
        at = pinhole - margin
        inside = ((at > 0) & (at < np.array(WIDE)[:, None] - 1)).all(0)
        found = np.stack([read_at(where[:, :, channel, k], *at[:, inside]) for k in (0, 1)])
        most = left["lensfun_px"] + left["colour_px"] + TRACED
        assert most < 0.1 and np.hypot(*(found - shown[:, inside])).max() < most and inside.sum() > 15
    plain = modifier(flags.DISTORTION | flags.SCALE).apply_geometry_distortion()
    shown, pinhole = case.place()
    at = pinhole - margin
    inside = ((at > 0) & (at < np.array(WIDE)[:, None] - 1)).all(0)
    found = np.stack([read_at(plain[..., k], *at[:, inside]) for k in (0, 1)])
    assert np.hypot(*(found - shown[:, inside])).max() < left["lensfun_px"] + TRACED
    for f_number in (22.0, 1.8):  # the shot's own aperture, and the widest
        camera_there = make_camera(GAUSS, Shot(film_mm=FILM, focus_m=FOCUS_M, f_number=f_number, clamp_f_number=True))
        y, x = ((np.linspace(0.5, 1, 9) * (n - 1)).astype(int) for n in WIDE[::-1])
        points = ((x + 0.5) - WIDE[0] / 2 + 1j * ((y + 0.5) - WIDE[1] / 2)) * PIXEL
        traced = fields.traced_light(
            camera_there, np.append(0j, points), spectrum_of(camera_there),
            fields.frame_of(camera_there), "rectilinear", FOCUS_M,
        ).light  # fmt: skip
        traced = traced[1:] / traced[0]
        picture = np.ones((*WIDE[::-1], 3), np.float32)
        picture[y, x] = traced[:, None]
        f_number = camera_there.settings["lens_state"]["f_number"]
        assert modifier(flags.VIGNETTING, f_number, np.float32).apply_color_modification(picture)
        share = np.abs(1 - 1 / picture[y, x, 1]) * traced  # of the axis's light: traced less the formula's
        assert share.max() < left["lensfun_share"] + 1e-3 and traced[-1] < 0.9


def test_opencv_and_nerfstudio_project_to_the_same_pixels(case: Case) -> None:
    cv2 = pytest.importorskip("cv2", reason="opencv-python-headless (extra dev) is not installed")
    point = (case.way.T * [1, -1, 1])[:, None]
    for kind, project in (("opencv", cv2.projectPoints), ("kannala-brandt", cv2.fisheye.projectPoints)):
        stored = cv2.FileStorage(str(case.folder / f"shot.{kind}.yaml"), cv2.FILE_STORAGE_READ)
        matrix, numbers = (stored.getNode(name).mat() for name in ("camera_matrix", "distortion_coefficients"))
        pixel = project(point, np.zeros(3), np.zeros(3), matrix, numbers)[0][:, 0].T
        assert np.hypot(*(pixel - case.place()[0])).max() < case.told["projections"][kind]["worst_px"] + TRACED
        block = json.loads((case.folder / f"shot.{kind}.json").read_text())
        assert block["fl_x"] == matrix[0, 0] and block["cx"] == matrix[0, 2] + 0.5


NODES = {  # of Nuke, with the knobs that are set
    "Root": "inputs first_frame last_frame fps format",
    "Camera2": "translate focal haperture vaperture focal_point fstop",
    "CheckerBoard2": "format",
    "Group": "addUserKnob folder light",
    "Input": "",
    "Output": "",
    "Reformat": "type format resize black_outside",
    "Read": "file_type file format first last origfirst origlast origset raw",
    "Expression": "expr0 expr1",
    "STMap": "channels uv",
    "Copy": "from0 to0",
    "Merge2": "operation disable",
}


def nuke_nodes(text: str) -> list[tuple[str, dict[str, str], list[str]]]:
    """Nodes of a script in order with their knobs and, input by input, the names of what they are connected to.

    A node takes its inputs from a stack, the last one first, and lies on it; a group has a stack of its own."""
    found, stacks, variables = [], [list[str]()], dict[str, str]()
    lines = iter(text.splitlines())
    for raw in lines:
        words = raw.split()
        if not words or raw.startswith("#"):
            continue
        if words[0] == "set":
            variables[words[1]] = stacks[-1][-1]
        elif words[0] == "push":
            stacks[-1].append(variables[words[1].lstrip("$")])
        elif words[0] == "end_group":
            stacks.pop()
        else:
            assert len(words) == 2 and words[1] == "{", raw
            knobs: dict[str, str] = {}
            for line in lines:
                if line.strip() == "}":
                    break
                name, _, value = line.strip().partition(" ")
                bare = re.sub(r"\\.", "", value)
                assert bare.count("{") == bare.count("}") and bare.count('"') % 2 == 0, line
                assert name in {"name", "inputs", "xpos", "ypos", *NODES[words[0]].split()}, line
                knobs[name] = value
            count = int(knobs.get("inputs", 0 if words[0] in ("Root", "Input") else 1))
            taken = [stacks[-1].pop() for _ in range(count)]
            if words[0] != "Root":
                stacks[-1].append(knobs["name"])
            found.append((words[0], knobs, taken))
            if words[0] == "Group":
                stacks.append([])
    assert len(stacks) == 1
    return found


def test_the_script_of_nuke_is_connected_and_its_places_are_the_maps(case: Case) -> None:
    nodes = nuke_nodes((case.folder / "shot.nk").read_text(encoding="utf-8"))
    names = [knobs["name"] for _, knobs, _ in nodes if "name" in knobs]
    first = names.index("neurolens_redistort")
    assert {names.count(n) for n in ("your_plate", "your_CG", "neurolens_pinhole")} == {1}
    inside = {knobs["name"]: (kind, knobs, taken) for kind, knobs, taken in nodes[first + 1 :] if "name" in knobs}
    assert inside["Output1"][2] == ["Vignetting"] and inside["Vignetting"][2] == ["Cropped", "Read_illumination"]
    assert inside["STMap"][2] == ["Padded", "Places"] and inside["Padded"][2] == ["Source"]
    assert inside["Copy_blue"][2] == ["Copy_green", "STMap_blue"] and inside["Cropped"][2] == ["Copy_blue"]
    named = re.findall(
        r'file "\\\[value parent\.folder]/([^"]+)"', (case.folder / "shot.nk").read_text(encoding="utf-8")
    )
    assert len(named) == 9 and all((case.folder / name).is_file() for name in named)
    # The plate lies in the middle of the undistorted format: so do the places that are read there.
    (wide, high), planes = case.told["undistorted_px"], read_channels(case.folder / "shot.undistort.exr")[0]
    places = next(knobs for kind, knobs, _ in nodes if kind == "Expression")
    for knob, channel, plate, size in (("expr0", "R", 480, wide), ("expr1", "G", 270, high)):
        scale, shift, over = map(float, re.fullmatch(r'"\([rg] \* (\d+) \+ (\d+)\) / (\d+)"', places[knob]).groups())  # type: ignore[union-attr]
        number = (planes[channel] * scale + shift) / over
        assert np.abs((number * size - (size - plate) / 2) / plate - planes[channel]).max() < 1e-5
    by_name = {knobs["name"]: knobs for kind, knobs, _ in nodes if kind == "Camera2"}["neurolens_pinhole"]
    row = case.told["frames"][0]
    assert float(by_name["focal"].strip("{}")) == row["focal_mm"][0]
    assert float(by_name["translate"].strip("{}").split()[2]) == pytest.approx(-row["before_film_mm"][0] / 1e3)


def test_the_script_of_blender_is_python_of_plain_values(case: Case) -> None:
    tree = ast.parse((case.folder / "shot.blender.py").read_text(encoding="utf-8"))
    values = {
        t.id: n.value for n in tree.body if isinstance(n, ast.Assign) for t in n.targets if isinstance(t, ast.Name)
    }
    [frame] = ast.literal_eval(values["FRAMES"])
    row = case.told["frames"][0]
    assert frame[:3] == (1, "", row["focal_mm"][0]) and ast.literal_eval(values["COLOURS"]) == ["red", "green", "blue"]
    film = ast.literal_eval(values["FILM_MM"])
    assert film == pytest.approx([n * PIXEL for n in case.told["undistorted_px"]])


def test_headers_and_the_readme_tell_what_there_is(case: Case) -> None:
    told = (case.folder / "README.md").read_text(encoding="utf-8")
    for path in case.folder.iterdir():
        name = re.sub(r"\.(undistort|redistort)\..*", r".\1", path.name)
        assert path.name == "README.md" or name.split(".")[1] in told and str(path) in case.told["files"]
    left = case.told["left"]
    for key in ("maps_px", "exit_px", "opentrackio_px", "lensfun_px", "colour_px"):
        assert f"{left[key]:.2g}" in told
    assert left["maps_px"] < 0.01 and left["lensfun_px"] < 0.1 and left["exit_px"] < 0.01
    assert read_card(GAUSS)["lens"]["sha256"][:16] in told


def test_no_file_tells_where_it_was_made(case: Case) -> None:
    for path in case.folder.iterdir():
        data = path.read_bytes()
        assert str(GAUSS.parent).encode() not in data and str(case.folder).encode() not in data, path.name


HOSTILE = '"; import os\n}} </lens>--> [exec rm] | {% raw %} \\'


def hostile(animated: bool = False) -> dict[str, Any]:
    """What templates are filled with, of a stranger's lens."""
    frame = Pinhole(1, "", 50.0, 1.0, 60.0, 2.0, 2.0, 2.1)
    frames = (
        (replace(frame, name=".0001"), replace(frame, number=2, name=".0002", focal_mm=51.0)) if animated else (frame,)
    )
    plates = SimpleNamespace(picture=(96, 54), undistorted=(100, 58), pixel_mm=(0.375, 0.375), overscan=(1.04, 1.07))
    known = {
        "lensModel": HOSTILE,
        "lensMake": HOSTILE,
        "lensSerialNumber": HOSTILE,
        "nominalFocalLength": 50.0,
        "aperture": 2.0,
    }
    shot = Handed(known, "0", (24000, 1001), frames, plates, ())  # type: ignore[arg-type]
    entry = files.LensfunEntry(50.0, 2.0, 50.0, (0.0, 0.0), (1.0, 0, 0), (1.0, 0, 0), ((2.0, 0, 0, 0),), 0.0, 0.0, 0.0)
    left = dict.fromkeys(("maps_px", "exit_px", "light_share", "lensfun_px", "colour_px", "lensfun_share"), 0.0)
    values = {"shot": shot, "about": HOSTILE, "entries": [entry], "left": left, "fits": {}, "notes": [HOSTILE]}
    return values | {"projection": "rectilinear", "parallax": [], "types": files.LENSFUN_TYPES}


@pytest.mark.parametrize("animated", [False, True])
def test_no_name_of_a_strangers_lens_is_read_as_code(animated: bool, tmp_path: Path) -> None:
    values = hostile(animated)
    texts = {n: html(f"handover.{n}.jinja", **values) for n in ("usda", "nk", "blender.py", "lensfun.xml", "README.md")}
    root = ElementTree.fromstring(texts["lensfun.xml"])
    assert root.findtext("lens/model") == HOSTILE and root.find("lens/calibration") is not None
    body = ast.parse(texts["blender.py"]).body
    assert [n.names[0].name for n in body if isinstance(n, ast.Import)] == ["os", "bpy"]
    # Python reads the encoding of a file from its first two lines, which a name must not reach.
    encoded = html("handover.blender.py.jinja", **values | {"about": "coding: utf-7 +AAo-import os.path+AAo-#"})
    assert ast.unparse(ast.parse(encoded.encode()).body[3]).startswith("ABOUT = 'coding: utf-7")
    dashes = html("handover.lensfun.xml.jinja", **values | {"about": "a---b--"})
    assert ElementTree.fromstring(dashes).findtext("lens/model") == HOSTILE
    assert len(nuke_nodes(texts["nk"])) == 21 and "\n}} </lens>" not in texts["nk"]
    assert "\n}} </lens>" not in texts["README.md"] and "<" not in texts["README.md"].replace("\\<", "")
    sample = html(
        "handover.opentrackio.json.jinja", shot=values["shot"], pinhole=values["shot"].frames[0], distortion=[],
        overscan=1.0, light=[0.0] * 3, focus_m=None, squeeze=(1, 1), ids=["a", "b"],
    )  # fmt: skip
    assert json.loads(sample)["static"]["lens"]["model"] == HOSTILE and "focusDistance" not in sample
    (tmp_path / "a.usda").write_text(texts["usda"])
    if animated:
        assert "focal {{curve x1 50.0 x2 51.0}}" in texts["nk"] and "translate {0 0 {curve x1 -0.06" in texts["nk"]
    pytest.importorskip("pxr", reason="usd-core (extra dev) is not installed")
    from pxr import Usd

    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    assert [str(p.GetPath()) for p in stage.Traverse()] == ["/Film", "/Film/Pinhole", "/Film/Lens"]
    if animated:
        assert stage.GetTimeCodesPerSecond() == pytest.approx(24000 / 1001)


def test_characters_that_xml_has_not_are_left_out() -> None:
    """In XML they are no text, and USD reads their escapes as letters; blanks of lines and other alphabets stay."""
    odd = "a\x01b\x08\x1f\x0c\uffff\ud800c\u00e9\u5149\U0001f4f7"
    known = {"lensModel": odd, "lensMake": odd, "lensSerialNumber": "0123456789abcdefgh"}
    values = hostile()
    shot = replace(values["shot"], attributes=known)
    assert shot.about == f"{odd} (sha256 0123456789abcdef)"
    values |= {"shot": shot, "about": shot.about}
    plain = "abc\u00e9\u5149\U0001f4f7"
    root = ElementTree.fromstring(html("handover.lensfun.xml.jinja", **values))
    assert root.findtext("lens/model") == root.findtext("lens/maker") == plain
    usd = html("handover.usda.jinja", **values)
    assert f'doc = "{plain} (sha256 0123456789abcdef)"' in usd and "\\u" not in usd
    for name in ("nk", "blender.py", "README.md"):
        assert not re.search("[\x00-\x08\x0b-\x1f\ud800-\udfff]", html(f"handover.{name}.jinja", **values))


def test_a_template_refuses_a_text_that_no_filter_has_quoted(monkeypatch: pytest.MonkeyPatch) -> None:
    from jinja2 import DictLoader

    from neurolens.base.html import _templates

    environment = _templates().overlay(
        loader=DictLoader({"a.jinja": "{{ x }}", "a.html": "{{ x }}", "b.xml.jinja": "{{ x }}"})
    )
    with pytest.raises(TypeError, match="needs a filter"):
        environment.get_template("a.jinja").render(x="rm")
    assert environment.get_template("a.jinja").render(x=1.5) == "1.5"
    assert {environment.get_template(n).render(x="<b>") for n in ("a.html", "b.xml.jinja")} == {"&lt;b&gt;"}


def test_formulas_of_light_are_found_again_and_the_square_of_directions_unfolds() -> None:
    radius = np.linspace(0.1, 20, 40)
    known = (-1e-3, 2e-6, -3e-9)
    found, left = falloff(1 + sum(k * radius**n for k, n in zip(known, (2, 4, 6), strict=True)), radius)
    assert found == pytest.approx(known, rel=1e-6) and left < 1e-12
    u, v = np.meshgrid(np.linspace(-0.99, 0.99, 21), np.linspace(-0.99, 0.99, 21))
    way = files.folded(u.reshape(-1), v.reshape(-1))
    assert np.allclose(np.abs(way).sum(0), 1) and way[2, 220] == -1  # the middle looks forward
    assert way[2, 0] > 0.9 and (way[0].reshape(21, 21)[10, 11:] > 0).all()  # corners look back; x grows to the right


@pytest.mark.parametrize("target", ["equidistant", "stereographic"])
def test_lookup_pictures_and_profiles_of_ideal_fisheyes_beyond_90_degrees(
    target: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An f theta camera of 10 mm, of which the film shows 114 degrees: places of directions in closed form."""
    monkeypatch.setattr(files, "SIDE", 513)
    monkeypatch.setattr(fields, "_ROUND", (129, 1))
    film, focal = (40.0, 40.0), 10.0
    camera = make_camera("fisheye-equidistant", Shot(film_mm=film, focus_m=math.inf, focal_length_mm=focal))
    field = field_of(camera, math.inf, target)
    plates = plates_of([field], (200, 200), film)
    angle = np.radians([0, 30, 80, 95, 109])
    way = np.stack([np.sin(angle), 0 * angle, -np.cos(angle)])
    place = files.place_of(field, plates, way)
    assert np.abs(place[0] - 0.5 - focal * angle / film[0]).max() < 1e-5 and np.abs(place[1] - 0.5).max() < 1e-9
    assert (files.place_of(field, plates, np.array([[0.0], [0.0], [1.0]])) == -1).all()
    enter = files.enter_map(field, plates)
    x = (np.arange(200) + 0.5 - 100) * film[0] / 200
    y = film[1] / 400
    angle = np.hypot(x, y) / focal
    assert np.abs(np.arctan2(np.hypot(enter["R"], enter["G"])[99], -enter["B"][99]) - angle).max() < 1e-5
    assert enter["B"][99].max() > 0.3  # beyond 90 degrees


def test_frames_have_their_own_files_and_an_interrupted_run_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fields, "_ROUND", (65, 1))
    monkeypatch.setattr(files, "SIDE", 65)
    folder = tmp_path / "pull"
    words = ("handover", f"thin:{EXACT}", "--film", "36x20.25", "--width", "96", "--frames", "1001:1002", "--key",
             "focus=1001:1,1002:3", "--f-number", "4", "--fps", "24000/1001", "--quiet", "-o", folder)  # fmt: skip
    real, count = files.exit_map, [0]

    def stopped(*given: Any) -> Any:
        count[0] += 1
        if count[0] == 2:
            raise KeyboardInterrupt
        return real(*given)

    monkeypatch.setattr(files, "exit_map", stopped)
    assert main([*map(str, words)]) == 130
    assert "files that were written are whole; the same command goes on" in capsys.readouterr().err
    kept = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    assert len(kept) == 9 and not any(name.startswith(".") for name in kept) and "shot.exit.1002.exr" not in kept
    monkeypatch.setattr(files, "exit_map", real)
    (folder / "shot.enter.1001.exr").write_bytes(b"damaged")
    cut = folder / "shot.undistort.1001.exr"
    whole, planes = cut.read_bytes(), read_channels(cut)[0]
    cut.write_bytes(whole[: len(whole) * 98 // 100])  # its header is whole
    told = run_json(capsys, *words)
    again = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    assert all(again[name] == kept[name] for name in kept if name not in ("shot.enter.1001.exr", cut.name))
    assert all(np.array_equal(plane, planes[name]) for name, plane in read_channels(cut)[0].items())
    assert read_metadata(folder / "shot.enter.1001.exr")["map"] == "enter"
    for kind in ("undistort", "redistort", "illumination", "enter", "exit"):
        assert {f"shot.{kind}.{n}.exr" for n in (1001, 1002)} <= set(again)
    samples = [json.loads((folder / f"shot.opentrackio.{n}.json").read_text()) for n in (1001, 1002)]
    near, far = (s["lens"] for s in samples)
    assert (near["focusDistance"], far["focusDistance"]) == (1, 3)
    assert near["pinholeFocalLength"] > far["pinholeFocalLength"]  # breathing
    assert [s["timing"]["sequenceNumber"] for s in samples] == [1001, 1002]
    assert samples[0]["timing"]["sampleRate"] == {"num": 24000, "denom": 1001}
    assert samples[0]["sampleId"] != samples[1]["sampleId"] and samples[0]["sourceId"] == samples[1]["sourceId"]
    profile = ElementTree.parse(folder / "shot.lensfun.xml")
    focal = [float(node.attrib["focal"]) for node in profile.iter("distortion")]
    assert focal == pytest.approx([far["pinholeFocalLength"], near["pinholeFocalLength"]])
    assert "shot.undistort.%04d.exr" in (folder / "shot.nk").read_text()
    assert told["left"]["lensfun_px"] < 0.1
    pytest.importorskip("pxr", reason="usd-core (extra dev) is not installed")
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(folder / "shot.usda"))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (1001, 1002)
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/Film/Lens"))
    assert camera.GetFocalLengthAttr().GetTimeSamples() == [1001, 1002]
    assert camera.GetFocalLengthAttr().Get(1002) == pytest.approx(far["pinholeFocalLength"])
    texture = camera.GetPrim().GetAttribute("omni:lensdistortion:lut:rayExitPositionTexture").Get(1002)
    assert texture.resolvedPath == str(folder / "shot.exit.1002.exr")


def test_what_a_standard_cannot_say_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fields, "_ROUND", (65, 1))
    monkeypatch.setattr(files, "SIDE", 65)
    small = ("--width", "64", "--quiet", "-o", tmp_path / "a")
    fisheye = ("fisheye-equidistant", "--film", "36x20.25")
    (tmp_path / "file").write_text("x")
    for words, said in (
        ((*fisheye, "--field", "220", *small), "at most 85, to be laid on a plane: --projection equidistant"),
        ((*fisheye, "--field", "60", *small), "a film within the image circle"),
        ((GAUSS, "--film", "36x20.25", *small, "--fps", "0"), "frames a second from 1 to 1000"),
        ((GAUSS, "--film", "36x20.25", *small, "--key", "focus=1:2"), "--frames beside it"),
        ((GAUSS, "--film", "36x20.25", "--width", "64", "-o", tmp_path / "file"), "a folder, not a file"),
        ((GAUSS, "--film", "36x20.25", "--size", "64x64", "--quiet", "-o", tmp_path / "a"), "shape of the film"),
    ):
        assert said in failure(capsys, "handover", *words)
        assert not (tmp_path / "a").exists()
    wide = ("handover", *fisheye, "--field", "220", *small[:2], "--projection", "equidistant", "-o", tmp_path / "f")
    assert main([*map(str, wide)]) == 0
    said = [line for line in capsys.readouterr().err.splitlines() if "not written" in line]
    assert len(said) == 2 and all("shot.opencv" in line and "up to 85 degrees" in line for line in said)
    assert not (tmp_path / "f" / "shot.opencv.yaml").exists() and (tmp_path / "f" / "shot.f-theta.json").exists()
    sample = json.loads((tmp_path / "f" / "shot.opentrackio.json").read_text())
    assert (
        "distortion" not in sample["lens"]
        and ElementTree.parse(tmp_path / "f" / "shot.lensfun.xml").findtext("lens/type") == "fisheye"
    )


def test_a_moved_film_is_told_of_or_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """OpenCV's numbers have the axis where the film has it; formulae of the radius about the picture's centre fail."""
    monkeypatch.setattr(fields, "_OTHER", (25, 16))
    monkeypatch.setattr(files, "SIDE", 65)
    words = (GAUSS, "--film", "24x16", "--width", "96", "--film-shift", "3", "--quiet", "-o", tmp_path / "a")
    told = run_json(capsys, "handover", *words)
    opencv = json.loads((tmp_path / "a" / "shot.opencv.json").read_text())
    assert (opencv["cx"], opencv["cy"]) == (48 - 3 / 24 * 96, 32) and told["projections"]["opencv"]["worst_px"] < 0.05
    sample = json.loads((tmp_path / "a" / "shot.opentrackio.json").read_text())
    assert "distortion" not in sample["lens"] and "opentrackio_px" not in told["left"]
    assert sum("film_shift_mm" in note for note in told["not_written"]) == 2


def test_what_formulae_leave_of_a_copy_is_that_of_the_whole_picture() -> None:
    """A copy whose picture is decentred, which no formula of the radius can say, is off by that at least."""
    camera = make_camera("thin", Shot(film_mm=(20.0, 16.0), focus_m=3.0, focal_length_mm=42.0))
    field, off = field_of(camera, 3.0), 0.01 + 0.02j
    shifted = [replace(polar, shift=sign * off) for sign, polar in ((1, field.ideal), (-1, field.picture))]
    field = replace(field, ideal=shifted[0], picture=shifted[1], light=field.light.repeat(4, 1))
    plates = plates_of([field], (600, 480), (20.0, 16.0))
    pinhole = Pinhole.of("", field, camera.settings, 3.0)
    shot = Handed({"cameraModel": "thin"}, "0", (24, 1), (pinhole,), plates, ())
    least = 0.999 * abs(off) / plates.pixel_mm[0]
    _, left_px, _ = files.opentrackio_sample(field, pinhole, shot)
    entry = files.lensfun_entry(field, camera, 3.0, shot, (611.4, 464.2), lambda f_number: camera)
    assert left_px is not None and min(left_px, entry.distortion_px) > least
    assert max(left_px, entry.distortion_px, entry.colour_px) < 2 * least


def test_an_anamorphic_lens_has_its_squeeze_where_a_standard_knows_one() -> None:
    """The pinhole's film is as much wider, pixels have its ratio; what knows spherical lenses alone is left out."""
    camera = make_camera("thin", Shot(film_mm=(20.0, 16.0), focus_m=3.0, focal_length_mm=42.0))
    field = replace(field_of(camera, 3.0), frame=fields.Frame((21.0, 42.0), (40.0, 40.0)))
    plates = plates_of([field], (60, 48), (20.0, 16.0))
    pinhole = Pinhole.of("", field, camera.settings, 3.0)
    shot = Handed({"cameraModel": "thin"}, "0", (24, 1), (pinhole,), plates, ())
    assert pinhole.squeeze == shot.pixel_aspect == 2 and shot.film_mm((60, 48)) == pytest.approx((40, 16))
    text, left_px, _ = files.opentrackio_sample(field, pinhole, shot)
    sample = json.loads(text)
    assert sample["static"]["camera"]["anamorphicSqueeze"] == {"num": 2, "denom": 1}
    assert sample["static"]["camera"]["activeSensorPhysicalDimensions"] == pytest.approx({"width": 20, "height": 16})
    assert "distortion" not in sample["lens"] and left_px is None
    writer = _Writer(None, [], shot)  # type: ignore[arg-type]
    assert writer._entries(None) == []  # type: ignore[arg-type]
    assert writer.notes == ["shot.lensfun.xml: lensfun knows no anamorphic lens"]
    values = hostile() | {"shot": shot, "entries": [], "notes": writer.notes}
    assert "lensfun knows no anamorphic lens" in html("handover.README.md.jinja", **values)
    assert '"60 48 0 0 60 48 2.0 neurolens_plate"' in html("handover.nk.jinja", **values)


def test_rates_are_fractions() -> None:
    assert (_rate("24"), _rate("24000/1001"), _rate("29.97")) == (24, Fraction(24000, 1001), Fraction(2997, 100))
    for text in ("0", "-24", "1/0", "nan", "1e9", "x", "9" * 30):
        with pytest.raises(argparse.ArgumentTypeError):
            _rate(text)
