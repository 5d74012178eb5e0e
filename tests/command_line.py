"""Running commands as from a shell: what they print as JSON, and the one line of those that fail."""

import json
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import cache
from io import StringIO
from pathlib import Path
from typing import Any

import pytest

from neurolens.cli import main


def run_json(capsys: pytest.CaptureFixture[str], *args: object) -> dict[str, Any]:
    """Run a command with --json and parse all of its stdout."""
    assert main([*map(str, args), "--json"]) == 0
    data: dict[str, Any] = json.loads(capsys.readouterr().out)
    return data


@cache
def described(path: Path) -> dict[str, Any]:
    """What `neurolens lens PATH --json` prints, run once however many tests read it; not to be changed."""
    with redirect_stdout(StringIO()) as out:
        assert main(["lens", str(path), "--json"]) == 0
    data: dict[str, Any] = json.loads(out.getvalue())
    return data


def failure(capsys: pytest.CaptureFixture[str], *args: object, run: Callable[[list[str]], int] = main) -> str:
    """Run a command that must fail with exit code 2, nothing on stdout, and one line on stderr; returns the line."""
    try:
        code = run([*map(str, args)])
    except SystemExit as stopped:
        code = int(stopped.code or 0)
    captured = capsys.readouterr()
    lines = captured.err.splitlines()
    assert (code, captured.out, len(lines)) == (2, "", 1), captured
    return lines[0]
