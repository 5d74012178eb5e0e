"""What a system may hand over: names that are no UTF-8, streams that are closed or of another encoding, places where no
file can be made."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from shipped import whole

from neurolens.cli import main
from neurolens.pictures.render.pictures import read_exr, read_metadata

ROOT = Path(__file__).parents[1]
LENS = ROOT / "lenses" / "cooke_triplet_50.toml"
SMALL = ["--width", "8", "--samples", "1", "--threads", "1", "--quiet"]


def neurolens(*words: object, closed: tuple[int, ...] = (), **variables: str) -> subprocess.CompletedProcess[bytes]:
    """A run of a process of its own, some of whose streams are closed."""
    begin = f"import os, sys\nfor n in {closed}: os.close(n)\nos.execv(sys.executable, [sys.executable, *sys.argv[1:]])"
    command = [
        sys.executable,
        "-c",
        begin,
        "-m",
        "neurolens",
        *(os.fspath(w) if isinstance(w, Path) else w for w in words),
    ]
    return subprocess.run(command, capture_output=True, cwd=ROOT, env=os.environ | variables, check=False)  # type: ignore[arg-type]


@pytest.mark.parametrize("closed", [(1,), (2,), (0, 1, 2), *whole(((1, 2),))])
def test_closed_streams_are_no_fault(closed: tuple[int, ...], tmp_path: Path) -> None:
    """The picture is whole, though the first file that is opened would have the number of a stream."""
    out = tmp_path / "a.exr"
    words = ["render", "experiments/scenes/grid.toml", "--camera", "thin", "--film", "36x24", *SMALL, "-o", str(out)]
    done = neurolens(*words, closed=closed)
    assert done.returncode == 0 and b"fault" not in done.stderr
    assert read_exr(out)[0].shape[1] == 8
    assert neurolens("lens", "none.toml", closed=closed).returncode == 2


@pytest.mark.parametrize("encoding", ["latin-1", *whole("ascii", "utf-8")])
def test_text_is_written_in_any_encoding(encoding: str, tmp_path: Path) -> None:
    file, name = tmp_path / "lens.toml", "Ğüß ı 日本"
    singlet = LENS.with_name("thorlabs_lb1471_biconvex_50.toml").read_text()
    file.write_text(singlet.replace("Biconvex singlet 50 mm", name), encoding="utf-8")
    code = "import sys; sys.modules['torch'] = None; from neurolens.cli import main; sys.exit(main(sys.argv[1:]))"
    said = []
    for words in (["a.toml"], ["b.toml", "--json"]):  # without torch, whose start takes seconds
        command = [sys.executable, "-c", code, "convert", file, "-o", tmp_path / words[0], *words[1:]]
        env = os.environ | {"PYTHONIOENCODING": encoding}
        said.append(subprocess.run(command, capture_output=True, cwd=ROOT, env=env, check=True).stdout)
    assert said[0].startswith(name.encode(encoding, "backslashreplace"))
    assert json.loads(said[1].decode(encoding))["name"] == name


@pytest.fixture
def cafe(tmp_path: Path) -> Path:
    """A folder whose name is café in Latin-1."""
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9"))
    try:
        folder.mkdir()
    except OSError:
        pytest.skip("this file system takes names of UTF-8 alone")
    return folder


def test_a_folder_may_have_a_name_that_is_no_utf_8(cafe: Path) -> None:
    """A picture and its tiles, of a scene, a lens and a lens of another program there; plates and lens files, too."""
    (cafe / "s\udce9.toml").write_text((ROOT / "experiments/scenes/grid.toml").read_text())
    (cafe / "l\udce9.toml").write_text(LENS.read_text())
    (cafe / "z\udce9.zmx").write_bytes((ROOT / "experiments/fuzz_seeds/lens.zmx").read_bytes())
    scene, lens, out = str(cafe / "s\udce9.toml"), str(cafe / "l\udce9.toml"), cafe / "o\udce9.exr"
    assert main(["render", scene, "--camera", lens, *SMALL, "-o", str(out)]) == 0
    for k in ("1/2", "2/2"):
        assert main(["render", scene, "--camera", lens, *SMALL, "--tile", k, "-o", str(out)]) == 0
    tiles = [str(cafe / f"o\udce9.tile-{k}-of-2.exr") for k in (1, 2)]
    assert main(["render", "--merge", *tiles, "--quiet", "-o", str(cafe / "m.exr")]) == 0
    assert (read_exr(cafe / "m.exr")[0] == read_exr(out)[0]).all()
    assert read_metadata(out)["scene"].endswith("caf\\udce9/s\\udce9.toml")
    assert main(["convert", str(cafe / "z\udce9.zmx"), "-o", str(cafe / "c.toml")]) == 0
    assert main(["stmap", lens, "--width", "8", "--height", "6", "--film", "24x18", "-o", str(cafe / "map")]) == 0


_FILM = ("--film", "36x24")
BROKEN = {
    "lens": ["lens", "broken.toml", "--layout"],
    "analyse": ["analyse", "broken.toml", "spots", "-o"],
    "verify": ["verify", "broken.toml", "--lens-file"],
    "rims": ["rims", "broken.toml", "-o"],
    "convert": ["convert", "broken.zmx", "-o"],
    "survey": ["survey", ".", "-o"],
    "view": ["view", "broken.toml", "-o"],
    "train": ["train", "broken.toml", "-o"],
    "plan": ["plan", "broken.toml", "--lens", "broken.toml", "-o"],
    "render": ["render", "broken.toml", "--camera", "broken.toml", "-o"],
    "flare": ["flare", "broken.toml", "--light", "0,0", "-o"],
    "ghost": ["flare", "broken.toml", *_FILM, "--light", "0,0", "--path", "g01-00"],
    "defocus": ["defocus", "broken.exr", "--lens", "broken.toml", *_FILM, "-o"],
    "bokeh": ["bokeh", "broken.toml", "--distance", "2", *_FILM, "-o"],
    "handover": ["handover", "broken.toml", *_FILM, "-o"],
    "stmap": ["stmap", "broken.toml", *_FILM, "-o"],
    "projection": ["projection", "broken.toml", "--projection", "opencv", *_FILM, "-o"],
    "export": ["export", "broken.toml", "--to", "c", "-o"],
    "blender": ["blender", "build", "--models", ".", "-o"],
    "add": ["blender", "add", "broken.toml", "--extension"],
    "mitsuba": ["mitsuba", "broken.xml", "--camera", "broken.toml", "-o"],
    "copies": ["copies", "broken.toml", "-o"],
    "psf": ["psf", "broken.toml", *_FILM, "-o"],
    "rays": ["rays", "broken.toml", *_FILM, "-o"],
    "models": ["models", "broken.toml", "--csv"],
    "demo": ["demo", "-o"],
}
ENDINGS = {
    **dict.fromkeys(("render", "flare", "defocus", "mitsuba"), ".exr"),
    **dict.fromkeys(("lens", "ghost"), ".png"),
    **dict.fromkeys(("verify", "rims", "convert"), ".toml"),
    **{"view": ".html", "blender": ".zip", "psf": ".npz", "rays": ".npz"},
}


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="it takes a folder where nobody can make a file: Linux")
@pytest.mark.parametrize("name", BROKEN)
def test_a_place_that_cannot_be_written_is_refused_before_any_file_is_read(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The inputs are broken, too; what is said first is that nothing can be written."""
    monkeypatch.chdir(tmp_path)
    for kind in ("toml", "exr", "zmx", "xml"):
        Path(f"broken.{kind}").write_text("broken")
    out = "/proc/self/neurolens" + ENDINGS.get(name, "")
    assert main([*BROKEN[name], out]) == 2
    said = capsys.readouterr().err
    assert "/proc/self" in said and "broken" not in said and said.count("\n") == 1
