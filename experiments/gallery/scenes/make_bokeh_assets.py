"""Make masks, signs and grids of lights for the scenes beside this file.

python experiments/gallery/scenes/make_bokeh_assets.py

The masks open the shares of the stop that Willi 2021 (Table 6.3) has for his: star 45.2%, heart 47.0%.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

TARGET = Path(__file__).parent
SIDE = 256
COLOURS = ([8.0, 6.8, 5.2], [8.0, 4.4, 1.6], [8.0, 1.6, 2.0], [2.4, 8.0, 4.0], [2.8, 4.8, 8.0])


def places() -> tuple[np.ndarray, np.ndarray]:
    """x right and y up of a mask's pixels, the stop's radius as unit."""
    middle = (np.arange(SIDE) + 0.5) / SIDE * 2 - 1
    x, y = np.meshgrid(middle, -middle)
    return x, y


def star(share: float = 0.452) -> np.ndarray:
    """Five points on the stop's rim, one of them up; the inner corners follow from the open share of the disc."""
    inner = share * np.pi / (5 * np.sin(np.pi / 5))
    x, y = places()
    angle = np.abs((np.arctan2(x, y) + np.pi / 5) % (2 * np.pi / 5) - np.pi / 5)  # from the nearest point
    u, v = np.hypot(x, y) * np.cos(angle), np.hypot(x, y) * np.sin(angle)
    corner_u, corner_v = inner * np.cos(np.pi / 5), inner * np.sin(np.pi / 5)
    return (1 - u) * corner_v - v * (1 - corner_u) >= 0


def heart(share: float = 0.470) -> np.ndarray:
    """(x^2 + y^2 - 1)^3 < x^2 y^3, of the size that opens `share` of the disc."""
    x, y = places()

    def of_scale(scale: float) -> np.ndarray:
        u, v = x / scale, y / scale + 0.1
        return ((u * u + v * v - 1) ** 3 < u * u * v**3) & (x * x + y * y <= 1)

    low, high = 0.3, 1.0
    for _ in range(40):
        scale = (low + high) / 2
        low, high = (scale, high) if of_scale(scale).sum() < share * np.pi / 4 * SIDE**2 else (low, scale)
    return of_scale(high)


def sign(text: str, size: int = 128) -> Image.Image:
    """A distance in black on white, framed."""
    picture = Image.new("L", (size, size), 255)
    draw = ImageDraw.Draw(picture)
    draw.rectangle((3, 3, size - 4, size - 4), outline=0, width=6)
    draw.text((size / 2, size / 2), text, fill=0, font=ImageFont.load_default(size=74), anchor="mm")
    return picture


def signs() -> str:
    """Six signs of 8 cm, 1.0 to 2.0 m before the film, three in a row, as TOML."""
    parts = []
    for k in range(6):
        distance = 1 + 0.2 * k
        x, y = (0.09 * (k % 3 - 1) * distance - 0.04, (0.053 if k < 3 else -0.048) * distance - 0.04)
        parts.append(
            f"""
[textures.sign-{10 + 2 * k}]
kind = "image"
file = "sign-{10 + 2 * k}.png"

[materials.sign-{10 + 2 * k}]
kind = "diffuse"
texture = "sign-{10 + 2 * k}"

[[quads]]
corner_m = [{x:.4f}, {y:.4f}, {-distance:.1f}]
edge_u_m = [0.08, 0.0, 0.0]
edge_v_m = [0.0, 0.08, 0.0]
material = "sign-{10 + 2 * k}"
"""
        )
    return "".join(parts)


def lights(points: Iterable[tuple[float, float, float]], angle: float) -> str:
    """Small balls of equal angular radius at camera points (x, y, distance), as a TOML array."""
    rows = []
    for k, (x, y, distance) in enumerate(points):
        colour = COLOURS[k % len(COLOURS)]
        ball = f"centre_m = [{x:.4f}, {y:.4f}, {-distance:.3f}], radius_m = {angle * distance:.5f}"
        rows.append(f"  {{ {ball}, emission = {colour} }},")
    return "spheres = [\n" + "\n".join(rows) + "\n]\n"


def camera(focus_m: float, film: tuple[float, float], f_number: float, note: str) -> str:
    """The camera's table and a dark sky."""
    return f"""
[camera]  # {note}
position_m = [0.0, 0.0, 0.0]
look_at_m = [0.0, 0.0, -1.0]
focus_m = {focus_m}
f_number = {f_number}
film_width_mm = {film[0]}
film_height_mm = {film[1]}
wavelengths_nm = [400, 700]
width = 240
height = {round(240 * film[1] / film[0])}
samples = 256
max_depth = 1

[environment]
colour = [0.01, 0.01, 0.015]
"""


STREET = """
[environment]
colour = [1.0, 1.0, 1.0]

[textures.floor]
kind = "checker"
colours = [[0.55, 0.48, 0.40], [0.20, 0.17, 0.15]]
cell_m = 0.1

[materials.floor]
kind = "diffuse"
texture = "floor"

[[planes]]
point_m = [0.0, -0.16, 0.0]
normal = [0.0, 1.0, 0.0]
material = "floor"

[materials.wall]
kind = "diffuse"
reflectance = [0.30, 0.42, 0.52]

[[planes]]
point_m = [0.0, 0.0, -4.0]
normal = [0.0, 0.0, 1.0]
material = "wall"
"""


def one_line(table: str) -> str:
    """A camera's table for one wavelength: a grey picture, without the noise of wavelengths."""
    return table.replace("[400, 700]", "[550, 550]")


def grid(
    focal_mm: tuple[float, float], xs_mm: Iterable[float], rows: Iterable[tuple[float, float]]
) -> list[tuple[float, float, float]]:
    """Lights whose pictures lie at the columns `xs_mm` and the rows (y mm, distance m) as printed.

    `focal_mm`: image distances in x and y.
    """
    xs = list(xs_mm)
    return [(x * d / focal_mm[0], y * d / focal_mm[1], d) for y, d in rows for x in xs]


def main() -> None:
    """Write them all."""
    for name, mask in (("star", star()), ("heart", heart())):
        Image.fromarray(mask * np.uint8(255)).convert("1").save(TARGET / f"{name}.png", optimize=True)
    for k in range(6):
        sign(f"{1 + 0.2 * k:.1f}").convert("P").save(TARGET / f"sign-{10 + 2 * k}.png", optimize=True)
    made = "# Made by make_bokeh_assets.py: "
    columns = np.linspace(-23.4, 23.4, 7)
    depths = [(14.0, 12.0), (7.0, 2.5), (0.0, 1.0), (-6.2, 0.78), (-12.6, 0.62)]
    scenes = {
        "lights-depths": (
            "lights from 12 m (top) through 1 m, in focus, to 0.62 m (bottom).",
            lights(grid((113, 113), columns, depths), 0.0035),
            camera(1.0, (54.0, 36.0), 2.0, "for a lens of 100 mm"),
        ),
        "lights-far": (
            "lights at 12 m behind a focus at 1 m: all discs should be alike.",
            lights(grid((113, 113), columns, [(y, 12.0) for y in (-14.0, -7.0, 0.0, 7.0, 14.0)]), 0.0035),
            camera(1.0, (54.0, 36.0), 2.0, "for a lens of 100 mm"),
        ),
        "lights-anamorphic": (
            "lights from 20 m (top) through 1.6 m, in focus, to 1.08 m (bottom), for a picture squeezed twice across.",
            lights(
                grid(
                    (21.7, 43.6),
                    np.linspace(-2, 2, 9),
                    [(1.25, 20.0), (0.62, 5.0), (0, 1.6), (-0.6, 1.3), (-1.2, 1.08)],
                ),
                0.0009,
            ),
            one_line(camera(1.6, (4.8, 3.2), 2.4, "the middle of the film of an anamorphic lens")),
        ),
    }
    stage = (
        one_line(camera(1.4, (24.0, 16.0), 2.0, "for 35 to 75 mm")).split("\n[environment]")[0]
        + "\n"
        + STREET
        + signs()
    )
    note = made + "signs 1.0 to 2.0 m before the film, 1.4 m in focus.\n"
    (TARGET / "signs.toml").write_text(note + stage.replace("samples = 256", "samples = 64"), encoding="utf-8")
    for name, (note, balls, rest) in scenes.items():
        (TARGET / f"{name}.toml").write_text(made + note + "\n\n" + balls + rest, encoding="utf-8")


if __name__ == "__main__":
    main()
