"""Runs the notebooks of the documentation cell by cell; ``python -m tests.notebooks`` writes their outputs anew."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, Final

FOLDER: Final = Path(__file__).resolve().parents[1] / "docs" / "notebooks"
ALONE: Final = ("battery", "log", "tracker")
"""Notebooks that need no robot."""
_RUN: Final = """
import contextlib, io, json, sys
names, printed = {"__name__": "__main__"}, []
for number, cell in enumerate(json.load(sys.stdin), start=1):
    with contextlib.redirect_stdout(io.StringIO()) as out:
        exec(compile(cell, f"cell {number}", "exec"), names)
    printed.append(out.getvalue())
json.dump(printed, sys.stdout)
"""


def cells(name: str) -> list[dict[str, Any]]:
    """Return the code cells of a notebook."""
    notebook = json.loads((FOLDER / f"{name}.ipynb").read_text(encoding="utf-8"))
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


def stored(name: str) -> list[str]:
    """Return what each code cell of a notebook printed when it was written."""
    return ["".join(text for output in cell["outputs"] for text in output["text"]) for cell in cells(name)]


def run(name: str, **environment: str) -> list[str]:
    """Run a notebook in its folder; returns what each code cell prints."""
    done = subprocess.run(
        [sys.executable, "-c", _RUN],
        input=json.dumps(["".join(cell["source"]) for cell in cells(name)]),
        cwd=FOLDER,
        env=os.environ | {"MPLBACKEND": "Agg"} | environment,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    printed: list[str] = json.loads(done.stdout)
    return printed


def write(name: str) -> None:
    """Run a notebook and store what its cells print."""
    file = FOLDER / f"{name}.ipynb"
    notebook, printed = json.loads(file.read_text(encoding="utf-8")), iter(run(name))
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            text = next(printed).splitlines(keepends=True)
            cell["outputs"] = [{"output_type": "stream", "name": "stdout", "text": text}] if text else []
    file.write_text(json.dumps(notebook, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    for each in ALONE:
        write(each)
