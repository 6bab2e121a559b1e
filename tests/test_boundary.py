"""The stack never meets the simulator: import contracts, and a process without a simulator."""

import subprocess
import sys
from pathlib import Path

import pytest
from importlinter import cli

ROOT = Path(__file__).parent.parent
STACK = sorted(
    ".".join(p.relative_to(ROOT).with_suffix("").parts)
    for p in (ROOT / "twin" / "stack").rglob("*.py")
)


def test_import_contracts_are_kept():
    config = str(ROOT / "pyproject.toml")
    assert cli.lint_imports(config_filename=config, no_cache=True) == cli.EXIT_STATUS_SUCCESS


def test_the_stack_loads_where_no_simulator_is():
    """Expected: every module of the stack loads, and none brings plant, viewer or simulator."""
    absent = ("mujoco", "dm_control", "rerun", "twin.plant")
    names = [n.removesuffix(".__init__") for n in STACK]
    code = (
        f"import sys, importlib; sys.modules.update(dict.fromkeys({absent}))\n"
        f"[importlib.import_module(n) for n in {names}]"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert run.returncode == 0, run.stderr


@pytest.mark.parametrize(
    "word", ["perf_counter", "time.time", "monotonic", "datetime", "random.seed"]
)
def test_the_stack_reads_no_wall_clock(word):
    files = [p for p in (ROOT / "twin" / "stack").rglob("*.py")]
    assert files
    assert [p.name for p in files if word in p.read_text()] == []


def test_the_stack_is_told_the_site_and_never_the_world():
    for path in (ROOT / "twin" / "stack").rglob("*.py"):
        lines = [s for s in path.read_text().splitlines() if "import" in s and "twin.layout" in s]
        assert not any("World" in s or "Layout" in s for s in lines), path
