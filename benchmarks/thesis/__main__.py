"""Chapter 5 of the thesis: its seven experiments, ours beside the author's own set-up in the same run.

    python -m benchmarks.thesis [--only 5.1 ...] [--quick] [--out FOLDER]

Figures, plots and a page of them (index.md, index.html) are written to runs/thesis. The last line is JSON.
"""

import argparse
import html
import importlib
import json
import os
import re
import sys
import time
from pathlib import Path

from benchmarks import ROOT

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from benchmarks.navigation_parts import Options, Part

EXPERIMENTS = {
    "5.1": "kinematics",
    "5.2": "slam",
    "5.3": "routes",
    "5.4": "deformation",
    "5.5": "tracking",
    "5.6": "exploration",
    "5.7": "computer",
}
OUT = ROOT / "runs" / "thesis"
HEAD = """<!doctype html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{title}</title>
<style>
body {{ font: 15px sans-serif; max-width: 70em; margin: auto; padding: 0 1em }}
img {{ max-width: 100% }}
div {{ overflow-x: auto }}
table {{ border-collapse: collapse; margin: 1em 0 }}
th, td {{ padding: 0.2em 0.8em; text-align: right; border-bottom: 1px solid #ccc }}
th {{ vertical-align: bottom }}
td:first-child {{ text-align: left }}
</style>
<h1>{title}</h1>"""
CODE = re.compile(r"`+(.+?)`+")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=EXPERIMENTS, default=list(EXPERIMENTS))
    parser.add_argument("--quick", action="store_true", help="a few seconds of each, for a look")
    parser.add_argument("--out", type=Path, default=OUT)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    options = Options(None, arguments.out, arguments.quick)
    whole = Part()
    for number in arguments.only:
        name = EXPERIMENTS[number]
        module = importlib.import_module(f"benchmarks.thesis.{name}")
        print(f"{number} {name}", flush=True)
        begin = time.perf_counter()
        part: Part = module.run(options)
        print(f"  {time.perf_counter() - begin:.0f} s", flush=True)
        saved = {"about": module.__doc__, "quick": arguments.quick, "figures": part.figures, "goals": part.goals}
        (arguments.out / f"{name}.json").write_text(json.dumps(saved, indent=1))
        whole.figures |= {f"{number}.{key}": value for key, value in part.figures.items()}
        whole.goals |= {f"{number}.{key}": value for key, value in part.goals.items()}
    write_report(arguments.out)
    print(json.dumps({"bench": "thesis", "figures": whole.figures, "goals": whole.goals, "met": whole.met}))
    return 0 if whole.met else 1


def write_report(out: Path) -> None:
    """One page of all experiments whose figures are in the folder, as Markdown and as HTML."""
    title = "The thesis's experiments"
    lines, page = [f"# {title}"], [HEAD.format(title=html.escape(title))]
    for number, name in EXPERIMENTS.items():
        file = out / f"{name}.json"
        if not file.exists():
            continue
        saved = json.loads(file.read_text())
        about, text = (part.strip() for part in saved["about"].strip().split("\n", 1))
        if saved["quick"]:
            text += "\n\nA quick look: figures mean nothing."
        lines += [f"\n## {about}\n", text, f"\n![{number}]({name}.png)"]
        page.append(f"<h2>{marked(about)}</h2>")
        page += [f"<p>{marked(one)}</p>" for one in text.split("\n\n")]
        page.append(f'<img src="{name}.png" alt="{number}">')
        for measures, rows in tables(saved["figures"]):
            heads = ["", *(measure.replace("_", " ") for measure in measures)]
            lines += ["", f"| {' | '.join(heads)} |", f"|---|{'---:|' * len(measures)}"]
            page.append(f"<div><table><tr>{''.join(f'<th>{html.escape(head)}' for head in heads)}</tr>")
            for row, values in rows.items():
                cells = [cell(values.get(measure), saved["goals"].get(key_of(row, measure))) for measure in measures]
                lines.append(f"| {' | '.join([row, *cells])} |")
                page.append(f"<tr>{''.join(f'<td>{html.escape(text)}' for text in [row, *cells])}</tr>")
            page.append("</table></div>")
    (out / "index.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (out / "index.html").write_text("\n".join(page), encoding="utf-8")


def marked(text: str) -> str:
    """Convert to HTML; text between backticks becomes code."""
    return CODE.sub(r"<code>\1</code>", html.escape(text))


def tables(figures: dict[str, float]) -> list[tuple[list[str], dict[str, dict[str, float]]]]:
    """Return columns and rows of figures named ``row.measure``: rows with a common measure share a table."""
    rows: dict[str, dict[str, float]] = {}
    for key, value in figures.items():
        row, _, measure = key.rpartition(".")
        rows.setdefault(row, {})[measure] = value
    found: list[tuple[list[str], dict[str, dict[str, float]]]] = []
    for row, values in rows.items():
        for measures, own in found:
            if values.keys() & set(measures):
                measures += [measure for measure in values if measure not in measures]
                own[row] = values
                break
        else:
            found.append((list(values), {row: values}))
    return found


def key_of(row: str, measure: str) -> str:
    """Return the figure's name."""
    return f"{row}.{measure}" if row else measure


def cell(value: float | None, goal: float | None) -> str:
    """Format a figure, with its goal if it has one."""
    if value is None:
        return ""
    text = f"{value:.0f}" if abs(value) >= 1000 else f"{value:.4g}"
    return text if goal is None else f"{text} (at most {goal:g}{'' if value <= goal else ': not met'})"


if __name__ == "__main__":
    sys.exit(main())
