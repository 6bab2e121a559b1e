"""Scenario warehouse_qr: both passes are told by the same figures, sampled alike."""

import numpy as np

from evaluation.run import RunRequest, RunResult
from scenarios import warehouse_qr
from twin.layout import load_layout

FIGURES = ("ape_aisle_rmse_m", "over_tags_error_p95_mm", "transport_time_s", "delivered",
           "placement_error_mm", "collisions", "qr_pose_error_p95_mm")  # fmt: skip


def test_the_pass_by_lidar_alone_is_reported_beside_the_one_with_tags(tmp_path, monkeypatch):
    """Expected: a filter that only the tags keep in the aisles falls short."""

    def transport(request, layout):
        value = 0.005 if layout.options.tags else 0.04
        return RunResult(dict.fromkeys(FIGURES, value), warehouse_qr.CRITERIA, complete=True)

    monkeypatch.setattr(warehouse_qr, "_transport", transport)
    result = warehouse_qr.run(RunRequest(seed=0, out=tmp_path), load_layout())
    assert result.metrics["ape_aisle_rmse_m"] == 0.005
    assert result.metrics["ape_aisle_rmse_lidar_m"] == 0.04
    assert result.metrics["over_tags_error_p95_lidar_mm"] == 0.04
    fell = [c.name for c in result.criteria if not c.passed(result.metrics.get(c.name, np.nan))]
    assert "ape_aisle_rmse_lidar_m" in fell and "ape_aisle_rmse_m" not in fell
