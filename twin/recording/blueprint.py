"""How the viewer opens a recording: the cell, the cameras, the map, plots and events."""

import rerun.blueprint as rrb

from twin.site import Site


def blueprint(site: Site) -> rrb.Blueprint:
    """Default views. The map looks down on the hall, north up; paths grow as time goes on."""
    x, y = sum(site.hall.x) / 2, sum(site.hall.y) / 2
    far = max(site.hall.x[1] - site.hall.x[0], site.hall.y[1] - site.hall.y[0])
    px, py, _ = site.pick
    so_far = rrb.VisibleTimeRange(
        "sim",
        start=rrb.TimeRangeBoundary.infinite(),
        end=rrb.TimeRangeBoundary.cursor_relative(seconds=0.0),
    )
    cell = rrb.Spatial3DView(
        name="cell",
        origin="world",
        contents=["$origin/**", "- $origin/paths/**", "- $origin/tags/**"],
        eye_controls=rrb.EyeControls3D(
            position=(px + 2.2, py - 2.2, 2.2), look_target=(px, py, 0.6), eye_up=(0, 0, 1)
        ),
    )
    above = rrb.Spatial3DView(
        name="map: true, localised, fused odometry, wheels alone",
        origin="world",
        contents=[
            "$origin/paths/**",
            "$origin/line/**",
            "$origin/hall/**",
            "$origin/tags/**",
            "$origin/navigation/**",
            "$origin/estimate/footprint",
        ],
        eye_controls=rrb.EyeControls3D(
            position=(x, y - 0.01, 1.2 * far), look_target=(x, y, 0), eye_up=(0, 1, 0)
        ),
        time_ranges=so_far,
    )
    cameras = rrb.Tabs(
        rrb.Spatial2DView(name="mast camera", origin="world/estimate/mast_camera"),
        rrb.Spatial2DView(name="depth camera", origin="world/estimate/rgbd/colour"),
        rrb.Spatial2DView(name="depth", origin="world/estimate/rgbd/depth"),
        rrb.Spatial2DView(name="floor camera", origin="world/estimate/floor_camera"),
    )
    plots = rrb.Tabs(
        rrb.TimeSeriesView(name="errors", origin="errors"),
        rrb.TimeSeriesView(name="picks", origin="picks"),
        rrb.TimeSeriesView(name="grippers", origin="grippers"),
        rrb.TimeSeriesView(name="drive", origin="drive"),
        rrb.TimeSeriesView(name="localisation", origin="localisation"),
        rrb.TimeSeriesView(name="goals", origin="goals"),
        rrb.TimeSeriesView(name="photoelectric network", origin="network"),
    )
    events = rrb.Tabs(
        rrb.TextLogView(name="events", origin="events"),
        rrb.TextDocumentView(name="metrics", origin="metrics"),
    )
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(cell, plots, row_shares=[3, 2]),
            rrb.Vertical(cameras, above, events, row_shares=[3, 3, 2]),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(timeline="sim", state="collapsed"),
        collapse_panels=True,
    )
