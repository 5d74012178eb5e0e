"""Executors: the answers of one machine, bit for bit, whatever happens to processes, workers and scheduler."""

import gc
import io
import json
import os
import socket
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, as_completed
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import failure
from some_tasks import count

from neurolens.base.cluster import Dask, packed, unpack, with_paths
from neurolens.base.errors import NeurolensError
from neurolens.base.files import noted_files, read_bytes
from neurolens.base.lensname import Named
from neurolens.base.tasks import Failed, Here, Processes, Shared, run_each
from neurolens.cli import main
from neurolens.pictures.frames import Frame
from neurolens.pictures.render.pictures import read_channels

Client = pytest.importorskip("distributed", reason="needs the extra dask").Client

CLUSTER = """
import logging, multiprocessing, sys
from distributed import LocalCluster
# Workers start with what their tasks import, which is imported once.
multiprocessing.get_context("forkserver").set_forkserver_preload(["distributed", *sys.argv[2:]])
if __name__ == "__main__":
    cluster = LocalCluster(n_workers=int(sys.argv[1]), threads_per_worker=1, dashboard_address=None, memory_limit=0,
                           silence_logs=logging.CRITICAL)
    print(cluster.scheduler_address, flush=True)
    sys.stdin.read()
"""

IMPORTED = (
    "neurolens.pictures.frames.farm",
    "neurolens.pictures.render.renderer",
    "neurolens.studies.survey",
    "neurolens.pictures.flare.layers",
)


class Cluster:
    """A scheduler and its workers, apart from this process."""

    def __init__(self, workers: int, folder: Path) -> None:
        (folder / "cluster.py").write_text(CLUSTER)
        more = {"PYTHONPATH": os.pathsep.join(sys.path), "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0"}
        more["DASK_DISTRIBUTED__WORKER__MULTIPROCESSING_METHOD"] = "forkserver"
        self.process = subprocess.Popen(
            [sys.executable, "cluster.py", str(workers), *IMPORTED], cwd=folder, stdin=subprocess.PIPE,
            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=os.environ | more,
        )  # fmt: skip
        assert self.process.stdout is not None
        self.address = self.process.stdout.readline().strip()

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    made = Cluster(2, tmp_path_factory.mktemp("cluster"))
    yield made.address
    made.kill()


def collected(executor: Executor, tasks: list[tuple[int, str]], common: bytes = b"") -> dict[int, bytes | Failed]:
    found = {}
    with executor:
        for (number, _), came in run_each(executor, count, iter(tasks), Shared(common)):
            assert number not in found
            found[number] = came
    return found


@pytest.mark.parametrize("place", ["here", "processes", "dask"])
def test_every_task_is_answered_once_and_errors_are_lines(place: str, cluster: str) -> None:
    make = {"here": Here, "processes": lambda: Processes(2), "dask": lambda: Dask(cluster)}[place]
    tasks = [(k, {3: "refuse", 5: "break"}.get(k, "")) for k in range(8)]
    found = collected(make(), tasks, b"n")
    for k in range(8):
        if k == 3:
            assert found[k] == Failed("lens.toml: radius_mm: got 3, expected a radius")
        elif k == 5:
            assert found[k].reason.startswith("a fault of neurolens: ZeroDivisionError: oh (some_tasks.py:")
        else:
            assert found[k] == b"n%d" % k
    assert collected(make(), []) == {}
    with make() as executor:  # as executors of the standard library are used
        futures = [executor.submit(count, Shared(b""), (k, "")) for k in range(3)]
        assert sorted(future.result() for future in as_completed(futures)) == [b"0", b"1", b"2"]


def test_a_process_that_ends_early_or_takes_too_long_costs_its_own_task() -> None:
    deeds = {1: "die", 2: "exit", 4: "sleep"}
    began = time.monotonic()
    found = collected(Processes(2, limit_s=3.0), [(k, deeds.get(k, "")) for k in range(6)])
    assert time.monotonic() - began < 300
    assert found.pop(1) == Failed("its process was killed by signal 9: did the memory run out?")
    assert found.pop(2) == Failed("its process ended with code 3")
    assert found.pop(4) == Failed("took longer than 3 s")
    assert found == {k: b"%d" % k for k in (0, 3, 5)}


def test_processes_end_with_an_iteration_that_is_left() -> None:
    executor = Processes(2)
    tasks = [(0, ""), (1, "sleep"), (2, "sleep"), (3, "")]
    for _, answer in run_each(executor, count, tasks, Shared(b"")):
        assert answer == b"0"
        break
    deadline = time.monotonic() + 60
    while executor._running:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    with pytest.raises(RuntimeError, match="shutdown"):
        executor.submit(count, Shared(b""), (1, ""))


def try_in(task: str) -> bytes:
    """Addresses of this worker and of its scheduler, and what an HTTP server of its answers."""
    from distributed import get_worker

    worker = get_worker()
    return json.dumps([worker.address, worker.scheduler.address, worker.http_server.port]).encode()


def test_workers_of_this_machine_are_of_this_process_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without keys nobody reaches them; ports for web pages are closed, or serve none."""
    pytest.importorskip("cryptography", reason="needs cryptography (the extra dask)")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    answers = run_each(Dask("local:1"), try_in, ["a", "b"])
    answer = next(answers)[1]
    assert isinstance(answer, bytes)
    worker, scheduler, port = json.loads(answer)
    before = socket.create_connection(("127.0.0.1", port), 5)
    before.sendall(b"GET /info/main/workers.html HTTP/1.0\r\n\r\n")
    assert b" 404 " in before.recv(100)
    before.close()
    for address in (worker, scheduler):
        assert address.startswith("tls://127.0.0.1:")
        for other in (address, address.replace("tls", "tcp")):
            stranger = Client.__new__(Client)  # at hand, so that it can be closed
            with pytest.raises((OSError, RuntimeError, ValueError, TypeError)):
                stranger.__init__(other, timeout="1s")
            stranger.close()
    assert [came for _, came in answers] == [answer]


def test_a_killed_worker_costs_only_its_task(cluster: str, tmp_path: Path) -> None:
    tasks = [(k, str(tmp_path / "killed") if k == 4 else "") for k in range(12)]
    assert collected(Dask(cluster), tasks) == {k: b"%d" % k for k in range(12)}
    assert (tmp_path / "killed").exists()


def test_a_task_that_kills_its_workers_fails_alone(cluster: str) -> None:
    found = collected(Dask(cluster), [(k, "die" if k == 1 else "") for k in range(4)])
    assert found.pop(1) == Failed("its worker was killed, again and again: did the memory run out?")
    assert found == {k: b"%d" % k for k in (0, 2, 3)}


def test_tasks_are_taken_as_there_is_room(cluster: str) -> None:
    """Of thousands, a scheduler holds a few."""
    taken = 0

    def tasks() -> Iterator[tuple[int, str]]:
        nonlocal taken
        for k in range(60):
            taken += 1
            yield k, ""

    with Dask(cluster) as executor:
        for done, (_, came) in enumerate(run_each(executor, count, tasks(), Shared(b"")), start=1):
            assert isinstance(came, bytes) and taken <= done + 4
    assert taken == 60


def test_no_such_scheduler(capsys: pytest.CaptureFixture[str], scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("neurolens.base.cluster._TIMEOUT", "0.5s")
    before = {id(c) for c in gc.get_objects() if type(c) is Client}
    line = failure(
        capsys, "render", scene, "--camera", "thin", "-o", scene.with_name("a.exr"), "--quiet", "--dask", "x"
    )
    assert line.startswith("neurolens: --dask x: ") and "expected tcp://HOST:PORT" in line
    clients = [c for c in gc.get_objects() if type(c) is Client and id(c) not in before]
    assert all(c.status == "closed" for c in clients)  # none is left to the collector
    options = ("--dask", "local", "--tile", "1/2")
    assert "--tile: got (1, 2), expected left out beside --dask" in failure(
        capsys, "render", scene, "--camera", "thin", "-o", scene.with_name("a.exr"), *options
    )


def test_files_travel_as_they_are_and_stay_in_their_folder(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "one.bin").write_bytes(bytes(range(256)))
    with noted_files() as noted:
        read_bytes(tmp_path / "a" / ".." / "a" / "one.bin", 999)
    assert noted == {tmp_path / "a" / "one.bin"}
    data = packed(noted)
    (there,) = unpack(data, tmp_path / "there")
    assert there.read_bytes() == bytes(range(256)) and there == tmp_path / "there" / str(noted.pop()).lstrip("/")
    assert data == packed({tmp_path / "a" / "one.bin"})
    evil = io.BytesIO()
    with zipfile.ZipFile(evil, "w") as archive:
        archive.writestr("../x", "y")
    with pytest.raises(NeurolensError, match="outside its folder"):
        unpack(evil.getvalue(), tmp_path / "there")


def test_paths_of_a_frame_move_with_it() -> None:
    frame = Frame(scene=Path("/a/s.toml"), camera=Named("fused:", Path("/a/1:2 lens")), glass_files=(Path("/g.agf"),))
    moved = with_paths(frame, lambda path: Path("/w") / str(path).lstrip("/"))
    assert (moved.scene, str(moved.camera)) == (Path("/w/a/s.toml"), "fused:/w/a/1:2 lens")
    assert moved.glass_files == (Path("/w/g.agf"),) and replace(moved, scene=frame.scene) != frame
    thin = Frame(scene=Path("/a/s.toml"), camera=Named("thin", None))
    assert str(with_paths(thin, Path.absolute).camera) == "thin"


@pytest.fixture
def framed(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., dict[str, bytes]]:
    """Renders two frames of several tiles each; the channels by file."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("neurolens.pictures.frames.farm._PATHS_OF_FEW", 300)
    frames = ("--frames", "1:2", "--key", "focus=1:1.5,2:3", "--samples", "2", "--quiet", "--camera", "thin")

    def run(name: str, *options: str) -> dict[str, bytes]:
        assert main(["render", scene.name, *frames, "-o", name, *options]) == 0
        stem = Path(name).stem
        found = {}
        for number in ("0001", "0002"):
            planes, told = read_channels(tmp_path / f"{stem}.{number}.exr")
            assert told["scene"] == scene.name and np.isfinite(planes["R"]).all()
            found[number] = b"".join(planes[key].tobytes() for key in sorted(planes))
        return found

    return run


def test_frames_of_a_cluster_are_those_of_one_machine(framed: Callable[..., dict[str, bytes]], cluster: str) -> None:
    assert framed("there.exr", "--dask", cluster) == framed("here.exr")
    assert not Path("there.exr.tiles").exists()
