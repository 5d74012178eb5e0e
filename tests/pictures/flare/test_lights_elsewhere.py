"""Lights of other programs' scenes: shares that show, lights that move, and stages of USD."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import failure, run_json

from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.states import set_lens
from neurolens.pictures.flare.canvas import Raster
from neurolens.pictures.flare.ghosts import GhostTracer, ghost_table
from neurolens.pictures.flare.job import FlareJob
from neurolens.pictures.flare.layers import flare_layers
from neurolens.pictures.flare.lights import Light, read_lights
from neurolens.pictures.render.pictures import read_channels
from neurolens.pictures.render.settings import FlareSettings
from neurolens.programs.blender import extension_library

ROOT = Path(__file__).parents[3]
TESSAR = ROOT / "lenses" / "brendel_tessar_100.toml"
FLARE = ("flare", TESSAR, "--film", "36x24", "--width", 48, "--cell", 24, "--bins", 2, "--quiet")
lights = extension_library("lights")
VIEW = np.eye(4)  # a camera at the origin that looks along -z


def listed(tmp_path: Path, *rows: dict[str, Any]) -> Path:
    path = tmp_path / "lights.json"
    path.write_text(json.dumps(rows))
    return path


def test_half_of_a_light_makes_half_the_flare(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Over frames, with the visible share linear between its keys."""
    row = {"light": "sun", "azimuth_deg": 8.0, "elevation_deg": 5.0, "diameter_deg": 0.5}
    path = listed(tmp_path, row | {"frame": 1}, row | {"frame": 3, "visible": 0.0})
    run_json(capsys, *FLARE, "--lights", path, "--frames", "1:3", "-o", tmp_path / "f.exr")
    whole, half, none = (read_channels(tmp_path / f"f.000{k}.exr")[0] for k in (1, 2, 3))
    assert whole["G"].max() > 0 and not none["G"].any()
    for name, picture in whole.items():
        np.testing.assert_allclose(half[name], picture / 2, rtol=1e-5, atol=1e-7 * picture.max())


@pytest.mark.parametrize("share", ["-0.1", "1.1", "half", True])
def test_shares_that_are_none_are_named(share: object, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = listed(tmp_path, {"azimuth_deg": 1, "elevation_deg": 0, "visible": share})
    assert "row 1, visible: got" in failure(capsys, *FLARE, "--lights", path)


def test_ghosts_of_a_moving_light_follow_it(tmp_path: Path) -> None:
    """Rows of a light that moves past a camera; its ghost's picture lies where rays of that direction meet the film."""
    rows = []
    for frame, x in enumerate((-0.4, -0.1, 0.5)):
        matrix = np.eye(4)
        matrix[:3, 3] = x, 0.3, -4.0
        seen = lights.see("sphere", matrix, (0.0,), True, np.zeros(3))
        rows.append(lights.row("lamp", frame, seen, VIEW, 1.0, 100 * seen.irradiance * np.ones(3), 1.0))
        assert math.tan(math.radians(rows[-1]["azimuth_deg"])) == pytest.approx(x / 4.0)
        assert rows[-1]["g"] == pytest.approx(100 / 4 / (x * x + 0.09 + 16))
    (track,) = read_lights(listed(tmp_path, *rows))
    lens = set_lens(read_lens(TESSAR), focus_m=4.0, f_number=16.0)
    name = min(ghost_table(GhostTracer(lens), Light(3, 3), 550.0)[:6], key=lambda g: g.size_mm).pair.name
    moved = []
    for frame in range(3):
        light = track.at(frame)
        assert light is not None
        job = FlareJob(lens, [light], Raster((60.0, 40.0), 120, 80), FlareSettings(bins=1, cell_px=8.0),
                       (545.0, 555.0), threads=1, single=(name,))  # fmt: skip
        picture = flare_layers(job)[name].sum(-1).astype(float)
        rows_, columns = np.indices(picture.shape)
        across, down = ((picture * at).sum() / picture.sum() for at in (columns + 0.5, rows_ + 0.5))
        place = (0.5 - across / 120) * 60, (down / 80 - 0.5) * 40  # pictures are turned by 180 degrees
        ghost = next(g for g in ghost_table(GhostTracer(lens), light, 550.0) if g.pair.name == name)
        assert place == pytest.approx(ghost.centre_mm, abs=0.5)
        moved.append(place[0])
    assert abs(moved[2] - moved[0]) > 2 and (moved[1] - moved[0]) * (moved[2] - moved[1]) > 0


def stage_of(path: Path, build: Any) -> Path:
    """A stage with a camera at the origin that looks along -z, in cm, y up."""
    usd = pytest.importorskip("pxr.Usd", reason="usd-core is not installed")
    from pxr import UsdGeom

    stage = usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    camera = UsdGeom.Camera.Define(stage, "/World/Camera")
    camera.CreateFocalLengthAttr(50.0)
    camera.CreateFStopAttr(64.0)
    build(stage)
    stage.Save()
    return path


def usd_rows(path: Path, frames: range = range(1)) -> list[dict[str, Any]]:
    from experiments.pictures.usd_lights import usd_rows as rows

    return rows(path, frames)


def test_lights_of_usd_dim_behind_a_moving_mesh(tmp_path: Path) -> None:
    """The share is that of a disc of which a chord takes a part; distances are in metres whatever the stage's unit."""
    places = np.linspace(-1.2, 1.2, 13)  # of the edge's shadow on the lamp, in radii

    def build(stage: Any) -> None:
        from pxr import Gf, UsdGeom, UsdLux

        lamp = UsdLux.SphereLight.Define(stage, "/World/Lamp")
        lamp.CreateRadiusAttr(30.0)
        lamp.CreateIntensityAttr(5.0)
        lamp.CreateExposureAttr(1.0)
        lamp.CreateColorAttr(Gf.Vec3f(1.0, 0.5, 0.25))
        lamp.AddTranslateOp().Set(Gf.Vec3d(0, 0, -400))
        wall = UsdGeom.Mesh.Define(stage, "/World/Wall")
        wall.CreatePointsAttr([(-5000, -1000, 0), (0, -1000, 0), (0, 1000, 0), (-5000, 1000, 0)])
        wall.CreateFaceVertexCountsAttr([4])
        wall.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
        moves = wall.AddTranslateOp()
        for frame, place in enumerate(places):
            moves.Set(Gf.Vec3d(place * 15.0, 0, -200), frame)

    rows = usd_rows(stage_of(tmp_path / "wall.usda", build), range(13))
    u = places.clip(-1, 1)
    expected = (np.arccos(u) - u * np.sqrt(1 - u * u)) / math.pi
    assert np.abs(np.array([row["visible"] for row in rows]) - expected).max() < 0.02
    assert rows[0]["distance_m"] == pytest.approx(4.0) and rows[0]["frame"] == 0
    assert rows[0]["diameter_deg"] == pytest.approx(2 * math.degrees(math.asin(30 / 400)))
    assert [rows[0][c] for c in "rgb"] == pytest.approx([10 * math.pi * (30 / 400) ** 2 * t for t in (1, 0.5, 0.25)])
    assert len(read_lights(listed(tmp_path, *rows))) == 1


def test_kinds_of_lights_of_usd(tmp_path: Path) -> None:
    """Radiance times solid angle, as UsdLux defines radiance; normalised, it does not depend on the size."""

    def build(stage: Any) -> None:
        from pxr import Gf, UsdLux

        for name, kind, settings, normalized in (
            ("Area", UsdLux.RectLight, {"width": 20.0, "height": 40.0}, False),
            ("Power", UsdLux.RectLight, {"width": 20.0, "height": 40.0}, True),
            ("Disc", UsdLux.DiskLight, {"radius": 10.0}, False),
            ("Bulb", UsdLux.SphereLight, {"radius": 10.0}, True),
            ("Cone", UsdLux.SphereLight, {"radius": 10.0, "shaping:cone:angle": 20.0}, False),
            ("Sun", UsdLux.DistantLight, {"angle": 2.0}, False),
            ("Hidden", UsdLux.SphereLight, {"radius": 10.0}, False),
            ("Dome", UsdLux.DomeLight, {}, False),
        ):
            light = kind.Define(stage, f"/World/{name}")
            UsdLux.ShapingAPI.Apply(light.GetPrim()).CreateShapingConeAngleAttr(180.0)
            UsdLux.LightAPI(light).CreateIntensityAttr(3.0)
            UsdLux.LightAPI(light).CreateNormalizeAttr(normalized)
            for key, value in settings.items():
                light.GetPrim().GetAttribute(f"inputs:{key}").Set(value)
            turn = light.AddRotateXYZOp()
            if name != "Sun":
                turn.Set(Gf.Vec3f(0, 120 if name in ("Area", "Cone") else 180, 0))  # towards the camera, or aside
            if name == "Hidden":
                light.MakeInvisible()
            light.AddTranslateOp(opSuffix="place").Set(Gf.Vec3d(0, 0, 0))
            light.GetPrim().GetAttribute("xformOpOrder")
            light.SetXformOpOrder([light.AddTranslateOp(opSuffix="far"), turn])
            light.GetPrim().GetAttribute("xformOp:translate:far").Set(Gf.Vec3d(0, 0, -200))

    with pytest.warns(match="left out: DomeLight"):
        rows = {row["light"].rpartition("/")[2]: row for row in usd_rows(stage_of(tmp_path / "kinds.usda", build))}
    far = 200.0**2
    expected = {
        "Area": 3 * 800 * math.cos(math.radians(60)) / far, "Power": 3 / far, "Disc": 3 * math.pi * 100 / far,
        "Bulb": 3 * 0.25 / far, "Cone": 0.0, "Sun": 3 * math.pi * math.sin(math.radians(1)) ** 2,
    }  # fmt: skip
    assert {name: row["g"] for name, row in rows.items()} == pytest.approx(expected, rel=1e-5)
    assert rows["Sun"]["diameter_deg"] == pytest.approx(2.0) and "distance_m" not in rows["Sun"]
    assert abs(rows["Sun"]["azimuth_deg"]) == pytest.approx(180.0)  # it shines along -z, as the camera looks


def test_stages_that_are_none_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pxr", reason="usd-core is not installed")
    from experiments.__main__ import main

    broken = tmp_path / "broken.usda"
    broken.write_text("#usda 1.0\n(")
    empty = stage_of(tmp_path / "empty.usda", lambda stage: None)
    (tmp_path / "bare.usda").write_text("#usda 1.0\n")
    for path, said in (
        (broken, "expected a USD stage"), (tmp_path / "missing.usda", "expected a USD stage"),
        (empty, "at least one of SphereLight"), (tmp_path / "bare.usda", "a stage with a camera"),
    ):  # fmt: skip
        line = failure(capsys, "usd-lights", path, "-o", tmp_path / "l.json", run=main)
        assert said in line and not (tmp_path / "l.json").exists()
