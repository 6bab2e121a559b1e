"""The command line: what it writes, what it returns, and how it turns bad input away."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from twin.cli import main

PACKAGE = "fake_scenarios"


def twin(*argv: str, package: str = PACKAGE) -> int:
    return main(argv, package)


def test_list_gives_each_scenario_and_its_first_line(capsys):
    assert twin("list") == 0
    out = capsys.readouterr().out
    assert "drift" in out and "A point drives one metre along x" in out
    assert "belt's speed" not in out


def test_the_products_own_scenarios_are_listed(capsys):
    assert main(["list"]) == 0
    said = capsys.readouterr().out
    for file in (Path(__file__).parent.parent / "scenarios").glob("[!_]*.py"):
        assert file.stem in said


def test_run_writes_report_and_trajectories(tmp_path, capsys):
    out = tmp_path / "deep" / "run"
    assert twin("run", "drift", "--seed", "3", "--out", str(out)) == 0
    report = json.loads((out / "report.json").read_text())
    assert {"scenario", "seed", "version", "sim_time_s", "wall_time_s", "rtf"} <= report.keys()
    assert report["seed"] == 3 and report["complete"] and report["passed"]
    assert report["criteria"][0].keys() == {"name", "value", "op", "limit", "passed"}
    assert report["metrics"]["first_grip_delay_s"] is None
    assert sorted(p.name for p in out.iterdir()) == ["estimate.tum", "report.json", "truth.tum"]
    text = capsys.readouterr().out
    assert "ape_max_m" in text and "<= 0.1" in text and "truth.tum" in text


def test_default_folder_is_named_after_scenario_and_seed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert twin("run", "drift", "--seed", "7") == 0
    assert (tmp_path / "runs" / "drift-seed7" / "report.json").is_file()


def test_same_seed_same_bytes(tmp_path):
    for name in "ab":
        twin("run", "drift", "--seed", "1", "--out", str(tmp_path / name))
    a, b = ((tmp_path / n) for n in "ab")
    assert (a / "estimate.tum").read_bytes() == (b / "estimate.tum").read_bytes()
    reports = [json.loads((f / "report.json").read_text()) for f in (a, b)]
    for report in reports:
        del report["wall_time_s"], report["rtf"], report["metrics"]["rtf"]
    assert reports[0] == reports[1]


def test_falling_short_returns_1(tmp_path):
    assert twin("run", "drift", "--out", str(tmp_path), "--set", "belt_speed=0.2") == 1
    assert json.loads((tmp_path / "report.json").read_text())["passed"] is False


def test_a_run_cut_short_is_incomplete_and_returns_1(tmp_path):
    assert twin("run", "drift", "--out", str(tmp_path), "--duration", "0.5") == 1
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["complete"] is False and report["sim_time_s"] == 0.5


def test_set_takes_several_values_in_either_form(tmp_path):
    values = ["--set", "belt_speed=0.1", "arms=1", "--set", "order=sma_f_n_m:2"]
    assert twin("run", *values, "drift", "--out", str(tmp_path)) == 0
    layout = json.loads((tmp_path / "report.json").read_text())["layout"]
    assert layout["world"]["line"]["speed"] == 0.1
    assert layout["options"]["arms"] == 1
    assert layout["world"]["order"] == {"sma_f_n_m": 2}


def test_a_failure_is_told_in_one_line_and_kept_in_full(tmp_path, capsys):
    assert twin("run", "drift", "--out", str(tmp_path), "--set", "belt_speed=0.4") == 1
    captured = capsys.readouterr()
    assert "RuntimeError: wheels fell off" in captured.out
    assert "Traceback" not in captured.out + captured.err
    assert "Traceback" in (tmp_path / "error.txt").read_text()
    assert json.loads((tmp_path / "report.json").read_text())["complete"] is False


def test_a_new_run_replaces_all_of_the_old_one_and_nothing_else(tmp_path):
    assert twin("run", "drift", "--record", "--out", str(tmp_path)) == 0
    for mine in ("mine.txt", "mine.tum", "experiment.log", "other.rrd"):
        (tmp_path / mine).write_text("keep")
    assert (tmp_path / "recording.rrd").is_file()
    assert twin("run", "drift", "--seed", "1", "--out", str(tmp_path)) == 0
    names = sorted(p.name for p in tmp_path.iterdir())
    kept = ["estimate.tum", "experiment.log", "mine.tum", "mine.txt", "other.rrd"]
    assert names == [*kept, "report.json", "truth.tum"]


MALFORMED = "[site\n"
BAD = {
    "no command": ([], "choose from list, run"),
    "unknown command": (["fly"], "choose from list, run"),
    "no scenario": (["run"], "NAME"),
    "unknown scenario": (["run", "dirft"], "choose from drift"),
    "unknown option": (["run", "drift", "--sed", "1"], "--seed"),
    "seed not a number": (["run", "drift", "--seed", "x"], "--seed"),
    "negative seed": (["run", "drift", "--seed", "-1"], "0 or greater"),
    "zero duration": (["run", "drift", "--duration", "0"], "positive"),
    "duration nan": (["run", "drift", "--duration", "nan"], "positive"),
    "unknown short name": (["run", "drift", "--set", "speed=1"], "belt_speed"),
    "unknown key": (["run", "drift", "--set", "world.line.sped=1"], "speed, friction"),
    "no value": (["run", "drift", "--set", "belt_speed"], "key=value"),
    "negative speed": (["run", "drift", "--set", "belt_speed=-0.1"], "-0.1"),
    "nan": (["run", "drift", "--set", "belt_speed=nan"], "nan"),
    "unknown class": (["run", "drift", "--set", "order=bnc:3"], "sma_f_n_m"),
    "overlap": (["run", "drift", "--set", "site.pick=[3.6,3.2,1.57]"], "stand in the belt"),
    "place named as a station": (
        ["run", "drift", "--set", 'site.places=[{{name="dock", pose=[1.0, 1.0, 0.0]}}]'],
        "place 'dock': there is another stop of that name",
    ),
    "missing layout": (["run", "drift", "--layout", "nowhere.toml"], "nowhere.toml"),
    "malformed layout": (["run", "drift", "--layout", "{malformed}"], "not a TOML file"),
    "missing model": (["run", "drift", "--set", "belt_speed=0.45"], "agv.xml: missing"),
    "no display": (["run", "drift", "--viewer"], "no display"),
}


@pytest.mark.parametrize("argv, said", BAD.values(), ids=BAD)
def test_bad_input_is_one_line_and_writes_nothing(argv, said, tmp_path, capsys, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    malformed, out = tmp_path / "bad.toml", tmp_path / "out"
    malformed.write_text(MALFORMED)
    assert twin("run", "drift", "--out", str(out)) == 0
    before = {p.name: p.read_bytes() for p in out.iterdir()}
    capsys.readouterr()
    argv = [a.format(malformed=malformed) for a in argv]
    place = ["--out", str(out)] if argv[:1] == ["run"] and len(argv) > 1 else []
    assert twin(*argv, *place) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert len(captured.err.strip().splitlines()) == 1
    assert captured.err.startswith("twin: ") and said in captured.err
    assert {p.name: p.read_bytes() for p in out.iterdir()} == before


@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
def test_a_complaint_is_one_statement_in_any_encoding(encoding):
    """Expected: the parser's box is taken off, also where it is drawn of dashes and bars."""
    run = [sys.executable, "-c", "import sys; from twin.cli import main; sys.exit(main())"]
    done = subprocess.run(
        [*run, "run", "pick_line", "--seed", "x"],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONIOENCODING": encoding},
    )
    assert done.returncode == 2 and done.stdout == ""
    said = "twin: Error parsing --seed: invalid literal for int() with base 10: 'x'"
    assert done.stderr.startswith(said) and done.stderr.count("\n") == 1
    assert done.stderr.rstrip().endswith("see twin run --help") and "--- " not in done.stderr


@pytest.mark.parametrize("place", ["file", "file/below", "taken"])
def test_a_folder_that_cannot_be_written_is_turned_away(place, tmp_path, capsys):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "taken" / "report.json").mkdir(parents=True)
    assert twin("run", "drift", "--out", str(tmp_path / place)) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1 and "--out" in captured.err
    assert (tmp_path / "file").read_text() == "mine"


def test_bad_input_leaves_no_folder_behind(tmp_path):
    out = tmp_path / "out"
    assert twin("run", "drift", "--out", str(out), "--set", "belt_speed=0.45") == 2
    assert not out.exists()


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_leaves_a_report(signum, tmp_path):
    code = f"import sys; from twin.cli import main; sys.exit(main(sys.argv[1:], '{PACKAGE}'))"
    run = ["run", "drift", "--record", "--out", str(tmp_path), "--set", "belt_speed=0.3"]
    process = subprocess.Popen(
        [sys.executable, "-c", code, *run],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent)},
        # As a shell script starts a job in the background: with interrupts ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN) and None,
    )
    assert process.stdout is not None
    assert process.stdout.readline().strip() == "ready"
    process.send_signal(signum)
    out, err = process.communicate(timeout=30)
    assert process.returncode == 1, err
    assert "Traceback" not in out + err
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["complete"] is False and report["passed"] is False
    assert report["metrics"]["ape_max_m"] is not None
    assert (tmp_path / "recording.rrd").read_bytes() == b"frames"
