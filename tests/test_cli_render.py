"""`neurolens render` when things go wrong: signals, places that cannot be written, checkpoints."""

import errno
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import failure, run_json
from PIL import Image
from shipped import whole

from neurolens.base.errors import InputError
from neurolens.cli import main
from neurolens.cli.keys import frames_of
from neurolens.pictures.render.pictures import read_exr, read_layers, write_exr


@pytest.fixture
def scene(scene: Path) -> Path:
    """Larger, and of more than one pass."""
    text = scene.read_text()
    for old, new in (("width = 32", "width = 64"), ("height = 18", "height = 36"), ("samples = 2", "samples = 16")):
        text = text.replace(old, new)
    scene.write_text(text)
    return scene


def children(process: subprocess.Popen[str]) -> list[int]:
    return [int(p) for p in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()]


def alive(pid: int) -> bool:
    """Whether a process runs; one that has ended may wait for somebody to ask."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def full(path: Path, *_: object, **__: object) -> None:
    """A writer on a full disk."""
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


def wait(condition: Any) -> None:
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="workers are forked on Linux")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL, *whole(signal.SIGTERM, signal.SIGHUP)])
def test_a_signal_in_mid_render_loses_nothing(
    number: int, scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The signal reaches the whole group, as from a terminal, or the command alone where it is killed."""
    out, part = tmp_path / "a.exr", tmp_path / "a.exr.part"
    arguments = ["render", scene.name, "--camera", "thin", "-o", out.name, "--quiet", "--checkpoint-every", "0.05"]
    command = [sys.executable, "-m", "neurolens", *arguments, "--samples", "100000"]

    def default() -> None:  # tests in the background of a shell, or under nohup, ignore some, and would hand that on
        for ignored in (signal.SIGINT, signal.SIGHUP):
            signal.signal(ignored, signal.SIG_DFL)

    process = subprocess.Popen(
        command, cwd=tmp_path, stderr=subprocess.PIPE, text=True, start_new_session=True, preexec_fn=default
    )
    wait(lambda: part.exists() or process.poll() is not None)
    workers = children(process)
    assert len(workers) == 2
    if number == signal.SIGKILL:
        process.kill()
    else:  # as `timeout` sends it, which is one request
        process.send_signal(number)
        os.killpg(process.pid, number)
    said = process.communicate(timeout=60)[1].strip()
    wait(lambda: not any(map(alive, workers)))
    if number == signal.SIGKILL:
        assert process.returncode == -signal.SIGKILL and said == "" and not out.exists()
    else:
        assert process.returncode == 128 + number
        count = r"[\d.e+]+ of 100000 samples per pixel( \(\d+ to \d+\))?"
        assert re.fullmatch(
            rf"neurolens: interrupted; a\.exr holds {count}; the same command resumes from a\.exr\.part", said
        )
        samples = read_layers(out)["samples"]
        # While one worker is in a tile the other goes on to that tile: those before it may be two passes ahead.
        assert samples.max() >= 16 and samples.max() - samples.min() <= 32
        assert not read_exr(out)[1]["render"]["complete"] and out.with_suffix(".png").exists()
    # So many samples that there is more to do, and not so many that it takes long.
    with np.load(part, allow_pickle=False) as kept:
        enough = 16 * (int(kept["done"].max()) + 2)
    common = ("render", scene, "--camera", "thin", "--quiet", "--samples", enough)
    data = run_json(capsys, *common, "-o", out, "--threads", 1)
    assert data["complete"] and not part.exists()
    run_json(capsys, *common, "-o", tmp_path / "b.exr")
    assert np.array_equal(read_exr(out)[0], read_exr(tmp_path / "b.exr")[0])
    one, other = read_layers(out), read_layers(tmp_path / "b.exr")
    assert sorted(one) == ["blocked", "depth", "samples", "variance"]
    assert all(np.array_equal(one[name], other[name]) for name in one)


def test_layers_are_chosen_and_explained(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "a.exr"
    common = ("render", scene, "--camera", "thin", "--quiet", "-o", out)
    run_json(capsys, *common, "--channels", "beauty")
    assert read_layers(out) == {} and "layers" not in read_exr(out)[1]
    run_json(capsys, *common, "--half")
    assert sorted(read_exr(out)[1]["layers"]) == sorted(read_layers(out))
    assert np.all(read_layers(out)["samples"] == 16)


def test_a_full_disk_keeps_what_it_can_and_says_what_is_lost(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out, part = tmp_path / "a.exr", tmp_path / "a.exr.part"
    write_exr(out, np.full((2, 2, 3), 7.0))
    common = ("render", scene, "--camera", "thin", "--quiet", "-o", out, "--threads", 1)

    def said(writers: list[str], *more: object) -> str:
        with monkeypatch.context() as patch:
            for writer in writers:
                patch.setattr(f"neurolens.pictures.{writer}", full)
            assert main([*map(str, (*common, *more))]) == 2
        assert np.all(read_exr(out)[0] == 7)
        first, _, why = capsys.readouterr().err.splitlines()[-1].partition("; ")
        assert first == f"neurolens: {out}: No space left on device"
        return why

    picture, both = ["frames.write_exr"], ["frames.write_exr", "render.renderer.write_checkpoint"]
    resumes, disk = f"the same command resumes from {part}", f"({part}: No space left on device)"
    lost = f"the render is lost, for the checkpoint cannot be written either {disk}"
    assert said(both, "--samples", 32) == lost
    # There is no checkpoint yet, then there is one that no other can take the place of: it has everything.
    for writers in (picture, both):
        assert said(writers) == f"the render is kept: {resumes}"
    assert said(both, "--samples", 32) == f"only a part of the render is kept {disk}: {resumes}"
    data = run_json(capsys, *common)
    assert data["complete"] and read_exr(out)[0].shape == (36, 64, 3)
    assert sorted(os.listdir(tmp_path)) == ["a.exr", "a.png", "ball.toml"]


@pytest.mark.parametrize("name", ["a.exr", "a.png", "a.exr.part"])
def test_a_folder_where_a_file_shall_be_is_one_line(
    name: str, scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).mkdir()
    line = failure(capsys, "render", scene, "--camera", "thin", "--quiet", "-o", tmp_path / "a.exr")
    assert line == f"neurolens: {tmp_path / name}: Is a directory"


def test_a_stale_checkpoint_is_one_line_and_restart_begins_again(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    common = ("render", scene, "--camera", "thin", "--quiet", "-o", tmp_path / "a.exr")
    run_json(capsys, *common, "--keep-checkpoint")
    line = failure(capsys, *common, "--f-number", "8")
    assert line == (
        f"neurolens: {tmp_path / 'a.exr.part'}: camera.f_number: got 4.0, expected 8.0 as asked now, "
        "or --restart to begin again"
    )
    run_json(capsys, *common, "--f-number", "8", "--restart")
    assert not (tmp_path / "a.exr.part").exists()


def test_a_picture_beyond_memory_is_one_line(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    common = ("render", scene, "--camera", "thin", "--quiet", "-o", tmp_path / "a.exr")
    with monkeypatch.context() as patch:
        patch.setattr("neurolens.pictures.render.film.os.sysconf", lambda _: 590)
        assert "64, 36" in (line := failure(capsys, *common)) and "2122 pixels" in line
    monkeypatch.setattr(
        "neurolens.pictures.render.film.mmap.mmap", lambda *_: (_ for _ in ()).throw(OSError(errno.ENOMEM, ""))
    )
    assert "out of memory" in failure(capsys, *common)


def test_a_texture_with_the_name_of_the_preview_is_not_written_over(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Image.new("RGB", (4, 2), "white").save(tmp_path / "ball.png")
    scene.write_text(scene.read_text().replace("colour = [1.0, 1.0, 1.0]", 'file = "ball.png"'))
    before = (tmp_path / "ball.png").read_bytes()
    said = failure(capsys, "render", scene, "--camera", "pinhole", "--quiet", "-o", tmp_path / "ball.exr")
    assert "--out" in said and "ball.png" in said and (tmp_path / "ball.png").read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ball.png", "ball.toml"]


KEYS = "frame,focus,f-number,position\n1,,2,0/0.5/5\n2,1,,\n3,,8,1/0.5/5\n4,inf,,\n"


def test_keys_of_files(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """CSV and JSON say what the same keys do on the command line; an error names the file, the row and the column."""
    words = ["focus=2:1,4:inf", "f-number=1:2,3:8", "position=1:0/0.5/5,3:1/0.5/5"]
    csv, js = tmp_path / "keys.csv", tmp_path / "keys.JSON"
    csv.write_text(KEYS)
    js.write_text(
        '[{"frame": 1, "f-number": 2, "position": [0, 0.5, 5]}, {"frame": 2, "focus": 1.0},'
        '{"frame": 3, "f-number": 8, "position": [1, 0.5, 5]}, {"frame": 4, "focus": "inf"}]'
    )
    expected = list(frames_of(range(1, 6), words, {}, "render"))
    for file in (csv, js):
        assert list(frames_of(range(1, 6), [str(file)], {}, "render")) == expected
    start = ("render", scene, "--camera", "thin", "-o", tmp_path / "b.exr", "--frames", "1:2", "--key", csv)
    for text, said in (
        ("frame,iso\n1,100\n", "row 1, iso"),
        ("frame,focus\n1,2\n1,3\n", "row 2, focus: got '1:3'"),
        ("frame,focus\n,2\n", "row 1, focus"),
        ("frame,focus\n1,2,3\n", "row 1"),
        ("frame,position\n1,1/2\n", "X/Y/Z"),
        ("frame,f-number\n1,nan\n", "row 1, f-number: got '1:nan'"),
    ):
        csv.write_text(text)
        told = failure(capsys, *start)
        assert said in told and "keys.csv" in told
    csv.write_text("frame,focus\n1,2\n")
    assert "each quantity once" in failure(capsys, *start, "--key", "focus=1:1")
    csv.unlink()
    assert "keys.csv" in failure(capsys, *start)
    for empty in ("", "frame,focus\n", "frame,focus\n1,\n2,\n", "frame\n1\n"):  # a file that was cut, for one
        csv.write_text(empty)
        assert "keys.csv: keys: got (none), expected a value of focus" in failure(capsys, *start)


def test_keys_take_units_and_every_number_of_a_shot() -> None:
    """Units are those of the options: 6 ft is 1.8288 m, f/4 is 4. A film offset moves evenly in mm."""
    words = ["focus=1:6ft,3:2.5e2cm", "f-number=1:f/4", "film-offset=1:0,3:0.1cm", "position=1:0/100cm/2m,3:0/1/3"]
    first, middle, last = (values for _, _, values in frames_of(range(1, 4), words, {}, "render"))
    assert first["focus_m"] == pytest.approx(1.8288) and last["focus_m"] == pytest.approx(2.5)
    assert middle["f_number"] == pytest.approx(4) and first["position_m"] == (0, 1, 2)
    assert [each["film_offset_mm"] for each in (first, middle, last)] == pytest.approx([0, 0.5, 1])
    with pytest.raises(InputError, match="FRAME:VALUE"):
        list(frames_of(range(1, 4), ["focus=1:2kg"], {}, "render"))


def test_frames_follow_their_keys_and_what_exists_is_kept(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Focus is linear in 1/m, the stop in stops, places in metres; held before the first key and after the last."""
    keys = ("--key", "focus=2:1,4:inf", "--key", "f-number=1:2,3:8", "--key", "position=1:0/0.5/5,3:1/0.5/5")
    command = ("render", str(scene), "--camera", "thin", "--frames", "1-5:2", *keys, "--quiet", "--samples", "1")
    (tmp_path / "a.0003.exr").write_bytes(b"kept")
    assert main([*command, "-o", str(tmp_path / "a.exr")]) == 0
    assert sorted(p.name for p in tmp_path.glob("a.*.exr")) == ["a.0001.exr", "a.0003.exr", "a.0005.exr"]
    assert (tmp_path / "a.0003.exr").read_bytes() == b"kept"
    again = [word for word in command if word != "--quiet"]
    assert main([*again, "-o", str(tmp_path / "a.exr")]) == 0
    assert "3 of 3 frames exist and are kept" in capsys.readouterr().err
    first, last = (read_exr(tmp_path / f"a.000{n}.exr") for n in (1, 5))
    cameras = [found[1]["camera"] for found in (first, last)]
    assert [(c["focus_m"], c["f_number"]) for c in cameras] == [(1.0, pytest.approx(2)), (None, pytest.approx(8))]
    # The same picture as of a scene that stands there.
    moved, out = tmp_path / "moved.toml", tmp_path / "moved.exr"
    moved.write_text(re.sub("position_m = .*", "position_m = [1.0, 0.5, 5.0]", scene.read_text()))
    state = ("--f-number", "8", "--focus", "inf", "--seed", "5", "--samples", "1")
    assert main(["render", str(moved), "--camera", "thin", "-o", str(out), *state]) == 0
    assert np.array_equal(read_exr(out)[0], last[0]) and not np.array_equal(first[0], last[0])
    assert main([*command, "-o", str(tmp_path / "a.exr"), "--restart"]) == 0
    middle = read_exr(tmp_path / "a.0003.exr")[1]["camera"]
    assert (middle["focus_m"], middle["f_number"]) == (pytest.approx(2), pytest.approx(8))
    # A frame that was interrupted goes on; one that fails ends the run.
    (tmp_path / "a.0001.exr.part").write_bytes(b"")
    asked: list[str] = []
    monkeypatch.setattr(
        "neurolens.cli.render.Render._render", lambda _, made, *__: asked.append(made.files.out.name) or 3
    )
    assert main([*command, "-o", str(tmp_path / "a.exr")]) == 3 and asked == ["a.0001.exr"]
    capsys.readouterr()
    for wrong, words in (
        (("--key", "focus=1:0"), "a number from 1e-06 to inf"),
        (("--key", "focus=1:1e400"), "a number from 1e-06 to inf"),
        (("--key", "f-number=1:1e-320"), "a number from 0.1 to 10000"),
        (("--key", "position=1:0/1"), "X/Y/Z"),
        (("--key", "focus=3:1,2:1"), "frames increasing"),
        (("--key", "iso=1:100"), "NAME of focus"),
        (("--key", "focus=1:1", "--focus", "2"), "left out"),
        (("--key", "focus=1:1", "--key", "focus=2:1"), "each quantity once"),
    ):
        start = ("render", scene, "--camera", "thin", "-o", tmp_path / "b.exr", "--frames", "1:2")
        assert words in failure(capsys, *start, *wrong)
    assert "--frames" in failure(capsys, "render", scene, "--camera", "thin", "-o", tmp_path / "b.exr", "--key", "a=1")
