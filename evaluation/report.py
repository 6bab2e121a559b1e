"""`report.json` of a run, and its table for the terminal."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.table import Table

from evaluation.run import RunRequest, RunResult
from twin import __version__
from twin.layout import Layout


def build_report(
    scenario: str,
    request: RunRequest,
    layout: Layout,
    result: RunResult,
    files: Sequence[str] = (),
) -> dict[str, Any]:
    """Everything a run has to say as plain numbers; NaN and infinity become None.

    Two runs of the same seed differ in `wall_time_s` and `rtf` alone (`rtf` stands among the
    metrics too). A run is passed if it came to its own end and met every criterion; what could
    not be measured counts as not met. `files` are the names of the run's own files.
    """
    metrics = {**result.metrics, "rtf": result.rtf}
    criteria = [
        {
            "name": c.name,
            "value": _number(value := metrics.get(c.name, math.nan)),
            "op": c.op,
            "limit": c.limit,
            "passed": c.passed(value),
        }
        for c in result.criteria
    ]
    return {
        "scenario": scenario,
        "seed": request.seed,
        "version": __version__,
        "sim_time_s": _number(result.sim_time),
        "wall_time_s": _number(result.wall_time),
        "rtf": _number(result.rtf),
        "complete": result.complete,
        "metrics": {name: _number(value) for name, value in metrics.items()},
        "criteria": criteria,
        "passed": result.complete and all(c["passed"] for c in criteria),
        "duration": request.duration,
        "layout": layout.model_dump(mode="json"),
        "files": list(files),
        "notes": list(result.notes),
    }


def write_report(path: Path, report: dict[str, Any]) -> None:
    """Write a report as strict JSON."""
    text = json.dumps(report, indent=2, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")


def read_report(path: Path) -> dict[str, Any]:
    """Read a report."""
    return json.loads(path.read_text(encoding="utf-8"))


def report_table(report: dict[str, Any]) -> Table:
    """Metrics beside their limits."""
    limits = by_name(report["criteria"])
    table = Table(title=f"{report['scenario']}, seed {report['seed']}", title_justify="left")
    table.add_column("metric")
    table.add_column("value", justify="right")
    table.add_column("limit", justify="right")
    table.add_column("")
    for name in [*report["metrics"], *(n for n in limits if n not in report["metrics"])]:
        value = report["metrics"].get(name)
        shown = "not measured" if value is None else format_value(value)
        here = limits.get(name)
        if here is None:
            table.add_row(name, shown, "", "")
            continue
        verdict = "[green]met[/]" if all(c["passed"] for c in here) else "[red]not met[/]"
        table.add_row(name, shown, show_limits(here), verdict)
    return table


def by_name(criteria: Sequence[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """A report's criteria by metric, which may have several."""
    found: dict[str, list[dict[str, Any]]] = {}
    for criterion in criteria:
        found.setdefault(criterion["name"], []).append(criterion)
    return found


def show_limits(criteria: Sequence[dict[str, Any]]) -> str:
    """All limits of a metric, such as `>= 0.9, <= 1.1`."""
    return ", ".join(f"{c['op']} {c['limit']:g}" for c in criteria)


def metrics_page(metrics: Mapping[str, float]) -> str:
    """Metrics as a table in Markdown."""
    rows = [f"| {n} | {format_value(v) if math.isfinite(v) else ''} |" for n, v in metrics.items()]
    return "\n".join(["| metric | value |", "|---|---:|", *rows])


def format_value(value: float) -> str:
    """Four significant digits, or a whole number as such."""
    if value == int(value) and abs(value) < 1e9:
        return str(int(value))
    return f"{value:.4g}"


def verdict(report: dict[str, Any]) -> str:
    """The outcome in one line."""
    missed = dict.fromkeys(c["name"] for c in report["criteria"] if not c["passed"])
    if report["passed"]:
        return "passed: every criterion met"
    parts = [] if report["complete"] else ["the run did not come to its end"]
    parts += [f"not met: {', '.join(missed)}"] if missed else []
    return f"fell short: {'; '.join(parts)}"


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
