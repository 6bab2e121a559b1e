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
    assert report["metrics"]["latency_ms"] > 0
    notes = "\n".join(report["notes"])
    assert "not those of the model card" in notes and "96.68" in notes
    assert {c["name"] for c in report["criteria"]} >= {"accuracy_min", "map50", "latency_ms"}
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


@pytest.mark.skipif(importlib.util.find_spec("torch") is not None, reason="PyTorch is here")
def test_training_without_pytorch(few, capsys):
    assert main(["train-detector"]) == 2
    assert "pip install 'twin[train]'" in capsys.readouterr().err
