"""Chapter 5 of the thesis: its seven experiments, ours beside the author's own set-up in the same run.

    python -m benchmarks.thesis [--only 5.1 ...] [--quick] [--out FOLDER]

Figures, plots and a page of them (index.md, index.html) go to runs/thesis. The last line is JSON.
"""

import argparse
import html
import importlib
import json
import os
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from navigation_parts import Options, Part

EXPERIMENTS = {
    "5.1": "kinematics",
    "5.2": "slam",
    "5.3": "routes",
    "5.4": "deformation",
    "5.5": "tracking",
    "5.6": "exploration",
    "5.7": "computer",
}
OUT = Path(__file__).resolve().parents[2] / "runs" / "thesis"


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
    """One page of all experiments whose figures are in the folder."""
    lines, page = ["# The thesis's experiments"], ["<!doctype html><title>The thesis's experiments</title>"]
    page.append("<style>body{font:15px sans-serif;max-width:70em;margin:auto}td{padding:0 1em}</style>")
    for number, name in EXPERIMENTS.items():
        file = out / f"{name}.json"
        if not file.exists():
            continue
        saved = json.loads(file.read_text())
        title, *about = saved["about"].strip().split("\n")
        lines += [f"\n## {number} {title.removeprefix(number).strip()}\n", "\n".join(about).strip()]
        page += [f"<h2>{html.escape(title)}</h2><p>{html.escape(' '.join(about))}</p><img src={name}.png>"]
        if saved["quick"]:
            lines.append("\nA quick look: figures mean nothing.")
            page.append("<p>A quick look: figures mean nothing.</p>")
        lines += [f"\n![{name}]({name}.png)\n", "| figure | value | goal |", "|---|---|---|"]
        page.append("<table><tr><th>figure<th>value<th>goal</tr>")
        for key, value in saved["figures"].items():
            goal = saved["goals"].get(key)
            goal_text = "" if goal is None else f"at most {goal:g}{'' if value <= goal else ' (not met)'}"
            lines.append(f"| {key} | {value:.4g} | {goal_text} |")
            page.append(f"<tr><td>{html.escape(key)}<td>{value:.4g}<td>{goal_text}</tr>")
        page.append("</table>")
    (out / "index.md").write_text("\n".join(lines) + "\n")
    (out / "index.html").write_text("\n".join(page))


if __name__ == "__main__":
    sys.exit(main())
