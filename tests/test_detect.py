"""`twin run detect` and `twin train-detector` from the command line, on a handful of pictures."""

import importlib.util
import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

from evaluation.pictures import PictureSet
from scenarios import detect
from twin.cli import main
from twin.layout import load_layout
from twin.training import command
from twin.training.domain import TRAINING


@pytest.fixture
def few(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(command, "HELD_OUT_PICTURES", 5)


def test_report_of_a_few_pictures(few, capsys):
    """Expected: figures, a table beside the source's, and a word that these are other pictures."""
    main(["run", "detect", "--out", "out"])
    with open("out/report.json") as file:
        report = json.load(file)
    assert report["complete"] and report["metrics"]["pictures"] == 5
    assert 0 < report["metrics"]["latency_ms"] < report["metrics"]["latency_with_poses_ms"]
    notes = "\n".join(report["notes"])
    assert "not those of the model card" in notes and "96.68" in notes
    assert {(c["name"], c["op"], c["limit"]) for c in report["criteria"]} == {
        ("accuracy_min", ">=", 0.99),
        ("recall_min", ">=", 0.99),
        ("accuracy_min_glare", ">=", 0.97),
        ("map50", ">=", 0.97),
        ("centroid_error_p95_mm", "<=", 1.0),
        ("axis_error_p95_deg", "<=", 2.0),
        ("latency_ms", "<=", 15.0),
        ("parameters", "<=", 500_000.0),
        ("part_size_median_px", "<=", 40.0),
        ("saturated_min_glare", ">=", 0.20),
    }
    assert "accuracy_min" in capsys.readouterr().out


@pytest.mark.parametrize(
    "words, said",
    [
        (["--steps", "0"], "--steps 0: must be 1 or greater"),
        (["--ablation-steps", "-1"], "--ablation-steps -1"),
        (["--pictures", "9"], "--pictures 9: must be 10 or greater"),
        (["--weights", "nowhere"], "--weights nowhere: there is no weights.npz"),
        (["--pictures", "many"], "see twin train-detector --help"),
    ],
)
def test_bad_input_of_the_training(words, said, capsys):
    assert main(["train-detector", *words]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1


def test_folders_of_other_pictures_are_refused(few, monkeypatch, capsys):
    monkeypatch.setattr(command, "NEEDED", ())
    monkeypatch.setattr(command, "DATA", Path("data"))
    monkeypatch.setattr(detect, "DATA", Path("data"))
    for part in ("training", "held-out"):
        Path("data", part).mkdir(parents=True)
        Path("data", part, "set.json").write_text('{"seed": 99}')
    assert main(["train-detector"]) == 2
    assert main(["run", "detect"]) == 2
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 2
    assert "training: holds pictures of another seed and domain and site; move it" in errors[0]
    assert "held-out: holds pictures of another seed" in errors[1]


def test_damaged_pictures_are_bad_input(few, monkeypatch, capsys):
    monkeypatch.setattr(detect, "DATA", Path("data"))
    Path("data/held-out").mkdir(parents=True)
    for name in ("000000.npy", "000000.json"):
        Path("data/held-out", name).write_bytes(b"half")
    assert main(["run", "detect"]) == 2
    error = capsys.readouterr().err
    assert "000000.json: damaged; delete it" in error and error.count("\n") == 1


def test_an_interrupt_ends_the_making_of_pictures(tmp_path):
    """Expected: the standard output closes, which both processes hold, long before the set is."""
    code = (
        "import sys; from twin.cli import main; from twin.training import command\n"
        "command.NEEDED = ()\n"
        "if __name__ == '__main__': sys.exit(main(['train-detector', '--out', sys.argv[1]]))"
    )
    words = [sys.executable, "-c", code, str(tmp_path)]
    pipe = subprocess.PIPE
    with subprocess.Popen(words, stdout=pipe, stderr=pipe, text=True) as process:
        until = time.monotonic() + 60.0
        while not (tmp_path / "training" / "set.json").exists() and time.monotonic() < until:
            time.sleep(0.05)
        process.terminate()
        _, error = process.communicate(timeout=20.0)
    assert process.returncode == 1 and error == "twin: interrupted\n"


def test_making_in_another_process_tells_how_far_it_is(tmp_path):
    told = []
    words = (tmp_path, load_layout(), TRAINING, 0, 3)
    command.make_apart(*words, lambda done, total, text: told.append((done, total, text)))
    assert told == [(0, 3, "training pictures"), (3, 3, "training pictures")]
    assert len(PictureSet(tmp_path)) == 3


@pytest.mark.parametrize("words", [["--record"], ["--log"], ["--duration", "5"]])
def test_what_has_no_effect_is_refused(words, few, capsys):
    assert main(["run", "detect", "--out", "out", *words]) == 2
    assert f"detect: {words[0]} has no effect here" in capsys.readouterr().err


@pytest.mark.skipif(importlib.util.find_spec("torch") is not None, reason="PyTorch is here")
def test_training_without_pytorch(few, capsys):
    assert main(["train-detector"]) == 2
    assert "pip install 'twin[train]'" in capsys.readouterr().err
