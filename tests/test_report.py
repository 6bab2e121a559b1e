"""Numbers of a report: pose errors against hand-worked values, TUM files, criteria."""

import json
import math

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.ape import heading, pose_errors
from evaluation.figures import figures, main
from evaluation.plots import plot_errors, plot_paths
from evaluation.report import (
    build_report,
    format_value,
    metrics_page,
    report_table,
    verdict,
    write_report,
)
from evaluation.run import Criterion, RunRequest, RunResult
from twin.geometry import quat_wxyz, rot_x, rot_z
from twin.layout import load_layout
from twin.recording.tum import read_tum, write_tum

matplotlib.use("Agg")
NAN = float("nan")


def straight(n=5):
    t = np.arange(n, dtype=float)
    return t, np.column_stack([t, np.zeros(n), np.zeros(n)])


# --- absolute pose error --------------------------------------------------------------------------


def test_ape_by_hand():
    """Expected: distances 0, 3, 4, 0, 0 give rmse sqrt(25/5) and maximum 4."""
    t, truth = straight()
    estimate = truth.copy()
    estimate[1, 1], estimate[2, 0] = 3.0, 6.0
    errors = pose_errors((t, truth), (t, estimate))
    assert errors.rmse == pytest.approx(math.sqrt(5.0))
    assert errors.maximum == pytest.approx(4.0)
    assert errors.where(np.array([True, True, False, False, False])).rmse == pytest.approx(
        math.sqrt(4.5)
    )


def test_ape_is_not_aligned():
    """Expected: an estimate that is off by a constant is off by just that."""
    t, truth = straight()
    assert pose_errors((t, truth), (t, truth + np.array([0.3, 0.4, 0.0]))).rmse == pytest.approx(
        0.5
    )


def test_yaw_error_is_taken_the_short_way_round():
    t, truth = straight()
    estimate = truth.copy()
    truth[:, 2], estimate[:, 2] = np.pi - 0.01, -np.pi + 0.01
    assert pose_errors((t, truth), (t, estimate)).yaw_rmse_deg == pytest.approx(np.degrees(0.02))


def test_estimate_is_interpolated_where_it_covers_the_truth():
    t, truth = straight()
    estimate = truth[:3] + np.array([0.0, 0.1, 0.0])
    errors = pose_errors((t, truth), (t[:3] + 0.5, estimate))
    assert errors.stamps.tolist() == [1.0, 2.0]
    assert errors.translation == pytest.approx([math.hypot(0.5, 0.1)] * 2)


def test_interpolation_of_yaw_crosses_the_cut():
    truth = (np.array([0.5]), np.array([[0.0, 0.0, np.pi]]))
    estimate = (np.array([0.0, 1.0]), np.array([[0, 0, np.pi - 0.2], [0, 0, -np.pi + 0.2]]))
    assert pose_errors(truth, estimate).yaw == pytest.approx([0.0], abs=1e-12)


def test_nothing_to_compare_is_nan():
    t, truth = straight()
    errors = pose_errors((t, truth), (np.zeros(0), np.zeros((0, 3))))
    assert math.isnan(errors.rmse) and math.isnan(errors.maximum)
    assert math.isnan(errors.yaw_rmse_deg)


@given(st.floats(-3.1, 3.1), st.floats(-0.3, 0.3))
def test_heading_of_a_quaternion_is_its_yaw(yaw, roll):
    q = quat_wxyz(rot_z(yaw) @ rot_x(roll))
    assert heading([[0, 0, 0, *q]]) == pytest.approx([yaw], abs=1e-9)


# --- files ----------------------------------------------------------------------------------------


def test_tum_lines_are_stamp_position_quaternion(tmp_path):
    write_tum(tmp_path / "a.tum", [0.01], [[1.0, 2.0, np.pi / 2]])
    expected = "0.010000 1.000000000 2.000000000 0.000000000 "
    expected += "0.000000000 0.000000000 0.707106781 0.707106781\n"
    assert (tmp_path / "a.tum").read_text() == expected


@pytest.mark.parametrize("columns", [3, 7])
def test_tum_round_trip_keeps_the_error(columns, tmp_path):
    rng = np.random.default_rng(0)
    t = np.arange(50) * 0.01
    poses = rng.normal(size=(50, columns))
    if columns == 7:
        poses[:, 3:] = [quat_wxyz(rot_z(a)) for a in rng.uniform(-3, 3, 50)]
    write_tum(tmp_path / "a.tum", t, poses)
    errors = pose_errors((t, poses), read_tum(tmp_path / "a.tum"))
    assert errors.maximum < 2e-9 and errors.yaw_rmse_deg < 1e-6


def test_tum_of_nothing(tmp_path):
    write_tum(tmp_path / "a.tum", np.zeros(0), np.zeros((0, 3)))
    with pytest.warns(UserWarning, match="no data"):
        assert read_tum(tmp_path / "a.tum")[1].shape == (0, 7)


def test_tum_refuses_poses_of_another_length(tmp_path):
    with pytest.raises(ValueError, match=r"a\.tum"):
        write_tum(tmp_path / "a.tum", [0.0, 1.0], [[0.0, 0.0, 0.0]])


# --- report ---------------------------------------------------------------------------------------


def report_of(**fields):
    request = RunRequest(seed=4, out=None)  # type: ignore[arg-type]
    return build_report("pick_line", request, load_layout(), RunResult(**fields))


def test_report_passes_only_when_complete_and_every_criterion_holds():
    limit = [Criterion("missed", "<=", 0)]
    assert report_of(metrics={"missed": 0}, criteria=limit, complete=True)["passed"]
    assert not report_of(metrics={"missed": 0}, criteria=limit, complete=False)["passed"]
    assert not report_of(metrics={"missed": 1}, criteria=limit, complete=True)["passed"]


@pytest.mark.parametrize("metrics", [{"missed": NAN}, {}])
def test_what_was_not_measured_is_null_and_fails(metrics, tmp_path):
    report = report_of(metrics=metrics, criteria=[Criterion("missed", "<=", 0)], complete=True)
    assert report["criteria"][0]["value"] is None and not report["criteria"][0]["passed"]
    write_report(tmp_path / "report.json", report)

    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    json.loads((tmp_path / "report.json").read_text(), parse_constant=refuse)


def test_unknown_operator_is_refused():
    with pytest.raises(ValueError, match="=<"):
        Criterion("missed", "=<", 0)


def test_table_names_each_metric_and_criterion_once():
    report = report_of(metrics={"missed": 0}, criteria=[Criterion("other", ">=", 1)])
    names = list(report_table(report).columns[0].cells)
    assert names == ["missed", "rtf", "other"]
    assert verdict(report) == "fell short: the run did not come to its end; not met: other"


def test_a_metric_with_two_limits_is_met_if_both_are():
    """Expected: both limits in table and summary; not met, though the last one is."""
    limits = [Criterion("gain", ">=", 0.9), Criterion("gain", "<=", 1.1)]
    low, good = (report_of(metrics={"gain": v}, criteria=limits) for v in (0.8, 1.0))
    for report, said in ((low, "[red]not met[/]"), (good, "[green]met[/]")):
        cells = [next(iter(column.cells)) for column in report_table(report).columns]
        assert cells[0] == "gain" and cells[2:] == [">= 0.9, <= 1.1", said]
    assert verdict(low).count("gain") == 1
    assert "| `gain` | >= 0.9, <= 1.1 |" in figures([low])


def test_values_are_shown_short():
    assert [format_value(v) for v in (20.0, 0.012345, 612.345)] == ["20", "0.01235", "612.3"]


# --- plots ----------------------------------------------------------------------------------------


def test_plots_show_every_trajectory_that_there_is(tmp_path):
    t, truth = straight()
    write_tum(tmp_path / "truth.tum", t, truth)
    write_tum(tmp_path / "estimate.tum", t, truth + np.array([0.0, 0.002, 0.0]))
    figure, (paths, errors) = plt.subplots(1, 2)
    plot_paths(paths, tmp_path, load_layout().site)
    plot_errors(errors, tmp_path)
    assert [line.get_label() for line in paths.lines] == ["floor tags", "true", "localised"]
    assert errors.lines[0].get_ydata() == pytest.approx(np.full(5, 2.0))
    plt.close(figure)


# --- many runs ------------------------------------------------------------------------------------


def run_of(seed: int, passed: bool, **metrics) -> dict:
    limit = {"name": "ape_max_m", "op": "<=", "limit": 0.1, "passed": passed}
    return {
        "scenario": "drift",
        "seed": seed,
        "passed": passed,
        "metrics": metrics,
        "criteria": [limit],
    }


def test_figures_over_runs():
    """Expected: median, least and greatest of what was measured, and how many runs passed."""
    reports = [
        run_of(102, True, ape_max_m=0.03, missed=None),
        run_of(101, False, ape_max_m=0.2, missed=4.0),
        run_of(100, True, ape_max_m=0.01, missed=2.0),
    ]
    table = figures(reports)
    assert "| `ape_max_m` | <= 0.1 | 0.03 | 0.01 | 0.2 |" in table
    assert "| `missed` |  | 3 | 2 | 4 |" in table
    assert "2 of 3 runs met every criterion (seeds 100, 101, 102)." in table


def test_figures_of_different_scenarios_are_not_mixed(tmp_path, monkeypatch, capsys):
    for name, scenario in (("a", "drift"), ("b", "other")):
        (tmp_path / name).mkdir()
        report = run_of(0, True, ape_max_m=0.0) | {"scenario": scenario}
        (tmp_path / name / "report.json").write_text(json.dumps(report))
    monkeypatch.setattr("sys.argv", ["figures", str(tmp_path / "a"), str(tmp_path / "b")])
    assert main() == 2
    monkeypatch.setattr("sys.argv", ["figures", str(tmp_path / "nowhere")])
    assert main() == 2
    assert capsys.readouterr().err.count("\n") == 2
    monkeypatch.setattr("sys.argv", ["figures", str(tmp_path / "a")])
    assert main() == 0
    assert "1 of 1 runs" in capsys.readouterr().out


def test_metrics_page_leaves_out_what_was_not_measured():
    assert metrics_page({"missed": 2.0, "rtf": NAN}).splitlines()[2:] == [
        "| missed | 2 |",
        "| rtf |  |",
    ]
