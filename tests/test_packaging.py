"""The wheel works by itself: models travel inside it, and it runs from any folder."""

import json
import os
import re
import site
import subprocess
import sys
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """Scripts folder of an environment in which the wheel, not the working tree, is installed."""
    place = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(place)]
    subprocess.run([*build, str(ROOT)], check=True, capture_output=True)
    (wheel,) = place.glob("*.whl")
    venv.create(place / "env", symlinks=True)
    scripts = place / "env" / "bin"
    python = scripts / "python"
    pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "--no-deps", "--quiet"]
    subprocess.run([*pip, "--no-index", str(wheel)], check=True)
    # Dependencies are borrowed from this environment: they come last on the path, and what makes
    # the working tree importable here is left out.
    code = "import sysconfig; print(sysconfig.get_path('purelib'))"
    packages = Path(subprocess.check_output([python, "-c", code], text=True).strip())
    borrowed = site.getsitepackages()
    lines = [*borrowed]
    for folder in map(Path, borrowed):
        lines += [
            line
            for pth in folder.glob("*.pth")
            if "twin" not in pth.name
            for line in pth.read_text().splitlines()
        ]
    (packages / "borrowed.pth").write_text("\n".join(lines) + "\n")
    return scripts


def run(command: list, cwd: Path) -> subprocess.CompletedProcess:
    env = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    return subprocess.run(
        list(map(str, command)), cwd=cwd, env=env, capture_output=True, text=True, timeout=300
    )


def test_models_come_from_the_wheel(installed, tmp_path):
    code = "from twin.layout import models_dir; import scenarios; print(models_dir()); "
    code += "print(scenarios.__file__)"
    done = run([installed / "python", "-c", code], tmp_path)
    models, scenarios = done.stdout.split()
    assert models.endswith("twin/_models") and str(ROOT) not in models + scenarios
    shipped = {p.relative_to(models) for p in Path(models).rglob("*") if p.is_file()}
    needed = [p for kind in ("xml", "toml") for p in (ROOT / "models").rglob(f"*.{kind}")]
    assert needed and shipped >= {p.relative_to(ROOT / "models") for p in needed}


def test_list_from_another_folder(installed, tmp_path):
    done = run([installed / "twin", "list"], tmp_path)
    assert done.returncode == 0, done.stderr
    assert "pick_line" in done.stdout


def test_a_short_run_from_another_folder(installed, tmp_path):
    command = [installed / "twin", "run", "pick_line", "--duration", "2", "--out", "here"]
    done = run(command, tmp_path)
    assert done.returncode == 1, done.stderr  # cut short, so its criteria are not met
    assert "Traceback" not in done.stdout + done.stderr
    report = json.loads((tmp_path / "here" / "report.json").read_text())
    assert report["sim_time_s"] == pytest.approx(2.0, abs=0.02)
    assert not (tmp_path / "here" / "error.txt").exists()
    assert (tmp_path / "here" / "truth.tum").read_text().count("\n") > 100


def test_constraints_are_names_and_versions_only():
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = [line for line in lines if line and not line.startswith("#")]
    assert len(pins) > 50
    assert [p for p in pins if not re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9._+!]+", p)] == []
    assert "mujoco==3.17.0" in pins
