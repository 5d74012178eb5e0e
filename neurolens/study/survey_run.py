"""A survey of a folder: its files become tasks, whose records are kept, and pages show them."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

from neurolens.base.errors import InputError, one_line
from neurolens.base.files import read_bytes, read_kept, safe_name, write_kept
from neurolens.base.progress import Progress
from neurolens.base.tasks import Failed, run_each
from neurolens.readers.any_format import Collection
from neurolens.readers.source import MAX_BYTES
from neurolens.study.survey import SurveySettings, Task, is_of, run_task, unread_record
from neurolens.study.survey_page import write_pages

_KEPT_EVERY_S, _SHARE = 60.0, 20.0  # pages are written so often beside the last time, for 1/20 of the time
TIME_LIMIT_S = 1800.0  # of one file, far more than any lens takes


def survey(
    collection: Collection,
    out: Path,
    settings: SurveySettings,
    executor: Executor,
    progress: Progress,
    *,
    glasses: Sequence[tuple[str, bytes]] = (),
    again: bool = False,
) -> list[dict[str, Any]]:
    """Survey all files of a collection; records that are there are not made again. Returns them in the files' order.

    The executor (see `base.tasks`) runs a task for each file. The folder `out` gets records/ (one JSON a file),
    survey.json, survey.csv and survey.html. The sections stay in the files alone: a survey holds some tens of thousands
    of bytes a lens in memory.
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
            for done, (task, data) in enumerate(run_each(executor, run_task, tasks()), start=1):
                if isinstance(data, Failed):
                    data = unread_record(task.name, "fault", data.reason)
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
