"""What the stack of a run is given: the drawing, and files of an earlier run."""

from pathlib import Path

from twin.layout import Layout, LayoutError
from twin.stack.config import StackConfig, nominal_config
from twin.stack.estimation.beacon_calibration import load_beacon_calibration as load_head
from twin.stack.estimation.site_map import load_site_map
from twin.stack.estimation.vehicle_calibration import load_calibration


def belief(layout: Layout) -> StackConfig:
    """The nominal drawing, with the calibrations of the options; maps are looked at.

    Raises:
        LayoutError: one line, for a file that cannot be read or is not of this site.
    """
    options, config = layout.options, nominal_config(layout.site, layout.options)
    try:
        for name in ("lidar", "fused") if options.map is not None else ():
            load_site_map(Path(options.map or "") / f"{name}.yaml", layout.site)
    except ValueError as error:
        raise LayoutError(f"options.map: {error}") from None
    for option, load in (("calibration", load_calibration), ("beacon_calibration", load_head)):
        path = getattr(options, option)
        try:
            config = config if path is None else load(Path(path)).applied(config)
        except ValueError as error:
            raise LayoutError(f"options.{option}: {error}") from None
    return config
