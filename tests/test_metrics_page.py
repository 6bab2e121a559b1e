"""docs/metrics.md names every figure of every report."""

import importlib
import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parent.parent / "docs"
SCENARIOS = ("pick_line", "odometry", "mapping", "navigate", "warehouse_qr", "kidnap")
GENERAL = ("rtf", "collisions")  # told above the sections


def sections(name: str) -> dict[str, str]:
    """Text below each heading of a page."""
    parts = re.split(r"^## ([^\n]+)\n", (DOCS / name).read_text(), flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def told(scenario: str) -> list[re.Pattern]:
    """Names in the first column of a section's table; `*` and `KIND` stand for anything."""
    rows = re.findall(r"^\| (`.*?`) \|", sections("metrics.md")[scenario], flags=re.MULTILINE)
    names = [name for row in rows for name in re.findall(r"`([^`]+)`", row)]
    return [re.compile(name.replace("*", ".+").replace("KIND", ".+")) for name in names]


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_every_figure_of_the_reports_is_explained(scenario):
    reported = set(re.findall(r"^\| `(\w+)` \|", sections("figures.md")[scenario], re.MULTILINE))
    reported |= {c.name for c in importlib.import_module(f"scenarios.{scenario}").CRITERIA}
    assert len(reported) > 5
    known = told(scenario)
    missing = {n for n in reported if not any(p.fullmatch(n) for p in known)}
    assert missing <= set(GENERAL)
