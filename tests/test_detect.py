"""`twin run detect` and `twin train-detector` from the command line, on a handful of pictures."""

import importlib.util
import json

import pytest

from twin.cli import main
from twin.training import command


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
        (["--pictures", "many"], "see twin train-detector --help"),
    ],
)
def test_bad_input_of_the_training(words, said, capsys):
    assert main(["train-detector", *words]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1


@pytest.mark.parametrize("words", [["--record"], ["--log"], ["--duration", "5"]])
def test_what_has_no_effect_is_refused(words, few, capsys):
    assert main(["run", "detect", "--out", "out", *words]) == 2
    assert f"detect: {words[0]} has no effect here" in capsys.readouterr().err


@pytest.mark.skipif(importlib.util.find_spec("torch") is not None, reason="PyTorch is here")
def test_training_without_pytorch(few, capsys):
    assert main(["train-detector"]) == 2
    assert "pip install 'twin[train]'" in capsys.readouterr().err
