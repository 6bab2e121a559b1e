"""One table from the reports of many runs of a scenario.

    python -m evaluation.figures runs/pick_line-seed10*

Each metric with its limit, the median over the runs and the range. Prints Markdown.
"""

import argparse
import json
import statistics
import sys
from pathlib import Path

from evaluation.report import by_name, show_limits


def figures(reports: list[dict]) -> str:
    """Markdown table over reports of one scenario; a metric that a run lacks is left out there."""
    limits = {n: show_limits(c) for n, c in by_name(reports[0]["criteria"]).items()}
    lines = ["| metric | limit | median | least | greatest |", "|---|---|---|---|---|"]
    for name in reports[0]["metrics"]:
        values = [r["metrics"].get(name) for r in reports]
        values = [v for v in values if v is not None]
        cells = [f"`{name}`", limits.get(name, "")]
        if values:
            cells += [f"{f(values):.4g}" for f in (statistics.median, min, max)]
        else:
            cells += ["", "", ""]
        lines.append(f"| {' | '.join(cells)} |")
    passed = sum(r["passed"] for r in reports)
    seeds = ", ".join(str(r["seed"]) for r in sorted(reports, key=lambda r: r["seed"]))
    lines.append(f"\n{passed} of {len(reports)} runs met every criterion (seeds {seeds}).")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folders", nargs="+", type=Path, help="folders with a report.json each")
    reports = []
    for folder in parser.parse_args().folders:
        try:
            reports.append(json.loads((folder / "report.json").read_text()))
        except (OSError, ValueError) as error:
            print(f"figures: {folder}: no readable report.json ({error})", file=sys.stderr)
            return 2
    if len({r["scenario"] for r in reports}) > 1:
        print("figures: these are reports of different scenarios", file=sys.stderr)
        return 2
    print(figures(reports))
    return 0


if __name__ == "__main__":
    sys.exit(main())
