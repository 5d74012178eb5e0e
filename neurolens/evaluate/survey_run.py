"""A survey of a folder: its files as tasks, processes that run them, records that are kept, pages."""

from __future__ import annotations

import json
import multiprocessing
import os
import select
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

from neurolens.base.engine import Failed, on_dask
from neurolens.base.errors import InputError, one_line
from neurolens.base.files import read_bytes, read_kept, safe_name, write_kept
from neurolens.base.progress import Progress
from neurolens.base.signals import end_at_once, held
from neurolens.evaluate.survey import SurveySettings, Task, is_of, run_task, unread_record
from neurolens.evaluate.survey_page import write_pages
from neurolens.readers.any_format import Collection
from neurolens.readers.source import MAX_BYTES

# Tasks to their records, in any order; tasks are taken one by one as there is room for them.
Engine = Callable[[Iterable[Task]], Iterator[tuple[Task, bytes]]]
_KEPT_EVERY_S, _SHARE = 60.0, 20.0  # pages are written so often beside the last time, for 1/20 of the time
_POLL_S = 0.5
TIME_LIMIT_S = 1800.0  # of one file, far more than any lens takes
_ANSWERED_S = 5.0  # until a worker's answer has gone


def survey(
    collection: Collection,
    out: Path,
    settings: SurveySettings,
    engine: Engine,
    progress: Progress,
    *,
    glasses: Sequence[tuple[str, bytes]] = (),
    again: bool = False,
) -> list[dict[str, Any]]:
    """Survey all files of a collection; records that are there are not made again. Returns them in the files' order.

    Writes records/ (one JSON a file), survey.json, survey.csv and survey.html to the folder `out`. The sections stay
    in the files alone: a survey holds some tens of thousands of bytes a lens in memory.
    """
    (out / "records").mkdir(parents=True, exist_ok=True)
    found: dict[str, dict[str, Any]] = {}
    missing: list[str] = []
    for name in collection.names:
        task = _task(collection, name, settings, glasses)
        kept = None if again or isinstance(task, bytes) else _kept(out, task)
        if kept is not None:
            found[name] = _without_layout(kept)
        elif isinstance(task, bytes):
            found[name] = json.loads(task)
        else:
            missing.append(name)
    if found and missing:
        progress.note(f"{len(found)} of {len(collection.names)} files are done already")

    def tasks() -> Iterator[Task]:
        for name in missing:
            task = _task(collection, name, settings, glasses)
            if isinstance(task, bytes):  # it changed meanwhile
                found[name] = json.loads(task)
            else:
                yield task

    def pages() -> None:
        there = [found[name] for name in collection.names if name in found]
        write_pages(there, lambda name: _layout(_record_file(out, name)), collection, out, settings)

    written, spent = time.monotonic(), 0.0
    if missing:
        with progress.stage("survey") as report:
            for done, (task, data) in enumerate(engine(tasks()), start=1):
                made = json.loads(data)
                write_kept(_record_file(out, task.name), made)
                found[task.name] = record = _without_layout(made)
                if record["reason"]:
                    progress.note(one_line(f"{task.name}: {record['verdict']}: {record['reason']}", 400))
                report(done / len(missing))
                if time.monotonic() - written > max(_KEPT_EVERY_S, _SHARE * spent):
                    began = time.monotonic()
                    pages()
                    written = time.monotonic()
                    spent = written - began
    pages()
    return [found[name] for name in collection.names]


def _task(
    collection: Collection, name: str, settings: SurveySettings, glasses: Sequence[tuple[str, bytes]]
) -> Task | bytes:
    """The task of a file, or the record of one that cannot be read."""
    try:
        data = read_bytes(collection.folder / name, MAX_BYTES, "a lens file")
    except InputError as error:
        return unread_record(name, "refused", f"{error.field}: got {error.value}, expected {error.expected}")
    return Task(name, data, settings, tuple(glasses))


def _record_file(out: Path, name: str) -> Path:
    return out / "records" / f"{safe_name(name)}.json"


def _kept(out: Path, task: Task) -> dict[str, Any] | None:
    record = read_kept(_record_file(out, task.name))
    return record if record is not None and is_of(record, task) else None


def _without_layout(record: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in record.items() if key != "layout"}


def _layout(file: Path) -> str:
    """The section that a record holds; none where there is no record."""
    return (read_kept(file) or {}).get("layout") or ""


def in_processes(jobs: int, limit_s: float = TIME_LIMIT_S) -> Engine:
    """An engine of this machine: every task in a process of its own, `jobs` at a time, whose memory ends with it.

    A process that is killed, or takes longer than `limit_s`, costs its own task only.
    """
    kind = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"
    context: Any = multiprocessing.get_context(kind)
    if kind == "forkserver":
        context.set_forkserver_preload([__name__])  # torch is loaded once; no thread of it runs there

    def run(tasks: Iterable[Task]) -> Iterator[tuple[Task, bytes]]:
        waiting, running = iter(tasks), dict[Any, tuple[Any, Task, float]]()
        try:
            more = True
            while more or running:
                while more and len(running) < jobs:
                    task = next(waiting, None)
                    more = task is not None
                    if task is not None:
                        place, process = _begin(context, task)
                        running[place] = process, task, time.monotonic()
                for place in wait(list(running), _POLL_S):
                    process, task, _ = running.pop(place)
                    yield task, _answer(place, process, task)
                for place, (process, task, began) in list(running.items()):
                    if time.monotonic() - began > limit_s:
                        del running[place]
                        process.kill()
                        place.close()
                        yield task, unread_record(task.name, "fault", f"took longer than {limit_s:g} s")
        finally:
            for process, _, _ in running.values():
                process.kill()

    return run


def on_cluster(address: str) -> Engine:
    """The engine of a Dask cluster, see `base.engine.on_dask`; a file that takes beyond `TIME_LIMIT_S` is a fault."""

    def run(tasks: Iterable[Task]) -> Iterator[tuple[Task, bytes]]:
        for task, came in on_dask(address, _on_worker)(tasks):
            yield task, unread_record(task.name, "fault", came.reason) if isinstance(came, Failed) else came

    return run


def _on_worker(_: bytes, task: Task) -> bytes:
    """The record of a file. A worker whose file takes too long ends once it has answered: threads cannot be stopped."""
    pool = ThreadPoolExecutor(1)
    try:
        return pool.submit(run_task, task).result(TIME_LIMIT_S)
    except TimeoutError:
        threading.Timer(_ANSWERED_S, os._exit, (1,)).start()
        return unread_record(task.name, "fault", f"took longer than {TIME_LIMIT_S:g} s")
    finally:
        pool.shutdown(wait=False)


def _begin(context: Any, task: Task) -> tuple[Any, Any]:
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(there, task), daemon=True)
    with held():  # this process handles Ctrl-C
        process.start()
    there.close()
    return here, process


def _work(place: Any, task: Task) -> None:
    end_at_once()
    threading.Thread(target=_end_unread, args=(place.fileno(),), daemon=True).start()
    with suppress(BrokenPipeError):  # whoever asked was killed
        place.send_bytes(run_task(task))


def _end_unread(pipe: int) -> None:
    """End this process once nobody is left to read from a pipe: a survey that was killed can ask nobody to stop."""
    if hasattr(select, "poll"):
        waiting = select.poll()
        waiting.register(pipe, 0)  # errors alone, such as a closed end
        waiting.poll()
        os._exit(1)


def _answer(place: Any, process: Any, task: Task) -> bytes:
    try:
        return place.recv_bytes()
    except EOFError:
        process.join()
        code = process.exitcode
        why = f"killed by signal {-code}: did the memory run out?" if code < 0 else f"ended with code {code}"
        return unread_record(task.name, "fault", f"its process was {why}" if code < 0 else f"its process {why}")
    finally:
        place.close()
        process.join()
