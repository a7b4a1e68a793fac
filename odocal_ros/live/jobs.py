"""The heavy work, as the worker thread runs it: pure of the node and its state."""

from std_msgs.msg import Header

from odocal_ros.calib.result import Calibration, LegResult
from odocal_ros.config import Config
from odocal_ros.leg import LegRecorder
from odocal_ros.live.outputs import paths
from odocal_ros.pipeline import calibrate, combine


def compute(recorder: LegRecorder, start_ns: int, stop_ns: int, kept: list[LegResult],
            config: Config) -> tuple[LegResult, Calibration, tuple]:
    """Return a leg's result, its combination with the legs kept, and the paths to show."""
    leg = recorder.close(start_ns, stop_ns, config.leg.preroll)
    result = calibrate(leg, config)
    calibration = combine([*kept, result], config)
    return result, calibration, leg_paths(result, config)


def recombine(kept: list[LegResult], config: Config) -> tuple[Calibration, tuple]:
    """Return the combination of the legs left, and the paths of the last."""
    return combine(kept, config), leg_paths(kept[-1], config)


def leg_paths(result: LegResult | None, config: Config) -> tuple:
    """Return the two paths of a leg, empty ones without a leg."""
    header = Header(frame_id=config.frames.local)
    if result is not None:
        header.stamp.sec, header.stamp.nanosec = divmod(result.stop_ns, 10**9)
    return paths(result, header)
