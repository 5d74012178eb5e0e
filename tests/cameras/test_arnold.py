"""The camera node for Arnold, compiled against a stub of its interface: rays, weights and derivatives by the pixel."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from camera_helpers import camera

from neurolens.cameras.shaders.source import camera_program
from neurolens.graph.c import Extras, write_c

ARNOLD = Path(__file__).parents[2] / "experiments" / "arnold"
# Calls the node as Arnold would, with two parameters and numbers of `AtCameraInput` from the standard input.
_DRIVER = """
#include <cstdio>
#include <initializer_list>
#include "neurolens_camera.cpp"
int main(int, char **given)
{
    AtNodeLib lib;
    if (!NodeLoader(0, &lib) || NodeLoader(1, &lib) || lib.node_type != AI_NODE_CAMERA) return 1;
    AtNode node;
    lib.methods->parameters(&node);
    node.numbers["units_per_m"] = given[1][0] == 'c' ? 100.0f : 1.0f;
    node.numbers["dispersion"] = given[2][0] == 'y';
    lib.methods->initialize(&node);
    lib.methods->update(&node);
    AtCameraInput in;
    while (std::scanf("%f %f %f %f %f %f", &in.sx, &in.sy, &in.dsx, &in.dsy, &in.lensx, &in.lensy) == 6) {
        AtCameraOutput out;
        lib.methods->create_ray(&node, in, out, 0);
        for (const AtVector &v : {out.origin, out.dir, out.dOdx, out.dOdy, out.dDdx, out.dDdy})
            std::printf("%.9g %.9g %.9g ", v.x, v.y, v.z);
        AtVector2 seen;
        const AtVector far(out.dir.x * 1e4f, out.dir.y * 1e4f, out.dir.z * 1e4f);
        const bool before = lib.methods->reverse_ray(&node, far, 0, seen);
        if (!before || lib.methods->reverse_ray(&node, AtVector(0, 0, 1), 0, seen)) return 2;
        std::printf("%.9g %.9g %.9g %.9g %.9g\\n", out.weight.r, out.weight.g, out.weight.b, seen.x, seen.y);
    }
    lib.methods->finish(&node);
}
"""
COUNT, PIXELS = 1000, 800


def test_the_node_gives_the_rays_of_the_camera_and_their_derivatives(tmp_path: Path) -> None:
    made = camera("polynomial")
    made.start("onnxruntime")  # whose derivatives are the graph's own, as the source's are
    program = camera_program(made.film, made.lens_graph(), derivatives=True)
    numbers = Extras({"film_width_mm": 36.0, "efl_mm": made.settings["efl_mm"]})
    (tmp_path / "lens.h").write_text(write_c(program, "lens", ["As `export --whole-camera` writes it."], numbers))
    for source in (ARNOLD / "neurolens_camera.cpp", ARNOLD / "stub" / "ai.h"):
        (tmp_path / source.name).symlink_to(source)
    rng = np.random.default_rng(0)
    screen, square = rng.uniform(-1, 1, (2, COUNT)) * [[0.95], [0.6]], rng.random((2, COUNT))
    pixel = np.array([[2 / PIXELS], [-2 / PIXELS]]).repeat(COUNT, 1)

    compiler = shutil.which("c++") or pytest.skip("no compiler of C++")
    flags = [
        "-std=c++14",
        "-O0",
        "-Wall",
        "-Wextra",
        "-Werror",
        f"-I{tmp_path}",
        "-x",
        "c++",
        "-",
        "-o",
        tmp_path / "a",
    ]
    done = subprocess.run([compiler, *flags, "-lm"], input=_DRIVER, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr

    def rays(*settings: str, shift: tuple[float, float] = (0, 0)) -> np.ndarray:
        columns = np.concatenate([screen + np.array([shift]).T, pixel, square]).T
        text = "\n".join(" ".join(f"{v:.9g}" for v in row) for row in columns)
        done = subprocess.run([tmp_path / "a", *settings], input=text, capture_output=True, text=True, check=True)
        return np.array(done.stdout.split(), np.float64).reshape(COUNT, -1).T

    found = rays("c", "no")
    wanted = made.sample(np.float32(-18 * screen), np.float32(square), np.full(COUNT, 587.56, np.float32))
    passed = wanted.status == 0
    assert passed.mean() > 0.9
    np.testing.assert_allclose(found[:3, passed], 100 * wanted.origin_m[:, passed], atol=5e-4)
    np.testing.assert_allclose(found[3:6, passed], wanted.direction[:, passed], atol=5e-6)
    np.testing.assert_allclose(found[18:21, passed], np.tile(wanted.weight[passed], (3, 1)), rtol=2e-4)
    assert not found[18:21, ~passed].any()
    # Derivatives by the pixel agree with the camera's own by the film point, and with the change of the ray over twenty
    # pixels; the outline of the pupil moves with the film point, too, and changes the ray a little.
    film, nm = np.float32(-18 * screen), np.full(COUNT, 587.56, np.float32)
    moves = made.sample_differentials(film, np.float32(square), nm).differentials
    for axis, slopes in ((0, [6, 7, 8, 12, 13, 14]), (1, [9, 10, 11, 15, 16, 17])):
        step = -18 * pixel[axis, 0]
        wanted_slopes = np.concatenate([100 * step * moves.origin_m[:, axis], step * moves.direction[:, axis]])
        scale = np.abs(wanted_slopes[:, passed]).max(1, keepdims=True)
        assert (np.abs(found[slopes] - wanted_slopes)[:, passed] / scale).max() < 1e-3
        shift = (20 * pixel[0, 0] * (axis == 0), 20 * pixel[1, 0] * (axis == 1))
        ahead, behind = rays("c", "no", shift=shift), rays("c", "no", shift=(-shift[0], -shift[1]))
        both = passed & (ahead[18] > 0) & (behind[18] > 0)
        change = (ahead - behind)[3 + axis, both] / 40
        assert np.median(np.abs(change / found[slopes[3 + axis]][both] - 1)) < 0.02
    # Colours: white on average, and another ray for another wavelength.
    coloured = rays("m", "yes")[:, passed]
    np.testing.assert_allclose(coloured[18:21].mean(1) / found[18, passed].mean(), 1, atol=0.1)
    apart = np.abs(coloured[:3] - found[:3, passed] / 100)[:, coloured[18:21].sum(0) > 0]
    assert 1e-7 < np.median(apart) and apart.max() < 1e-3
    # Points far ahead are where their rays come from, but for distortion.
    assert np.abs(found[21:, passed] - screen[:, passed]).max() < 0.1
