"""What would help a planned calibration most: each change computed, ranked by its gain."""

from collections.abc import Callable
from dataclasses import dataclass, replace
import math

import numpy as np

from odocal_ros.calib.combine import combine_method
from odocal_ros.calib.planned_drive import PlannedDrive
from odocal_ros.calib.predict import predict, Prediction, Sigmas
from odocal_ros.calib.result import Estimate, MethodResult
from odocal_ros.config import GRADES, with_settings
from odocal_ros.output.figures import length, time_span

SCALE, YAW = 'scale_factor', 'yaw_mounting_angle'
RTK = 0.02                        # m
OUTSIDE_HEADING = math.radians(0.1)     # of two antennas a metre or two apart
LEAST_REST = 60.0                 # s
WORTH = 0.98                      # of a sigma: what leaves more is no help


@dataclass(frozen=True)
class Change:
    """A change and the sigmas it leaves, relative and rad; None: not determined."""

    text: str
    scale: float | None
    yaw: float | None

    def gain(self, before: Prediction, parameter: str) -> float:
        """Return how many times smaller the sigma gets; inf where there was none before."""
        now, then = self.sigma(parameter), before.sigma(parameter)
        if now is None:
            return 1.0 if then is None else 0.0
        return math.inf if then is None else then / now

    def sigma(self, parameter: str) -> float | None:
        """Return the sigma of a parameter."""
        return self.scale if parameter == SCALE else self.yaw


def changes(drive: PlannedDrive, sigmas: Sigmas, before: Prediction) -> list[Change]:
    """Return what could be changed, each with its outcome, in no order."""
    tried: list[tuple[str, Callable[[], Prediction]]] = [
        (f'{length(drive.distance)} more, straight on',
         lambda: predict(drive.lengthened(drive.distance), sigmas))]
    rest = [max(LEAST_REST, s) for s in before.standing]
    tried.append((f'standing {time_span(max(rest))} longer at both marks',
                  lambda: predict(drive.standing_longer(max(rest)), sigmas)))
    if sigmas.fix > 2 * RTK:
        tried.append((f'RTK fixes ({RTK:g} m)', lambda: predict(
            drive, replace(sigmas, fix=RTK, fix_up=2 * RTK))))
    tried += _better_sensors(drive, sigmas, before)
    farthest = _until_farthest(drive, sigmas)
    if farthest is not None:
        tried.append((f'marking the end where you are farthest off ({length(farthest.distance)})',
                      lambda: predict(farthest, sigmas)))
    found = [Change(text, *(outcome.sigma(p) for p in (SCALE, YAW)))
             for text, outcome in ((text, run()) for text, run in tried)]
    return found + _second_leg(drive, sigmas, before)


def _better_sensors(drive, sigmas, before):
    """Return the changes of heading and Imu that are better than what there is."""
    out = []
    now = before.alignment.heading_sigma if before.alignment.heading_separable else math.inf
    better = OUTSIDE_HEADING if now > 2 * OUTSIDE_HEADING else now / 2
    config = with_settings(sigmas.config, {'alignment.heading_source': 'heading_topic',
                                           'alignment.heading_sigma': better})
    out.append((f'a heading known to {math.degrees(better):.2g} deg',
                lambda: predict(drive, replace(sigmas, config=config))))
    grade = GRADES.index(sigmas.config.imu.grade)
    if grade + 1 < len(GRADES):
        finer = with_settings(sigmas.config, {'imu.grade': GRADES[grade + 1]})
        out.append((f'an Imu of {GRADES[grade + 1]} grade',
                    lambda: predict(drive, replace(sigmas, config=finer))))
    return out


def _until_farthest(drive, sigmas):
    """Return the drive up to where it is farthest from the start, None if that is the end."""
    inside = drive.t >= 0
    ds = np.gradient(drive.travel[inside])
    place = np.cumsum(ds * np.exp(1j * drive.yaw[inside]))
    k = int(np.argmax(np.abs(place - place[0])))
    if abs(place[-1] - place[0]) > 0.9 * abs(place[k] - place[0]):
        return None
    rest = max((b - a for a, b in drive.standstills(sigmas.config.leg.standstill)
                if a <= drive.t[inside][k] <= b), default=30.0)
    moving = np.flatnonzero((np.abs(drive.speed) > 1e-6) & (drive.t <= drive.t[inside][k]))
    return drive.until(float(drive.t[min(moving[-1] + 1, len(drive.t) - 1)]), rest)


def _second_leg(drive, sigmas, before):
    """Return two legs combined: the other way, and once more the same way."""
    if before.sigma(SCALE) is None:
        return []
    other = predict(drive.turned_around(), sigmas)
    both = combine_method('two_point', [_whole(before.method), _whole(other.method)])
    yaw = both.estimates[YAW].sigma if before.sigma(YAW) is not None else None
    return [Change('a second leg in the other direction', both.estimates[SCALE].sigma, yaw)]


def _whole(method: MethodResult) -> MethodResult:
    """Return the method with a value for what it does not determine, so that legs combine."""
    known = {name: e if e.value is not None else Estimate(0.0, 0.0, e.unit)
             for name, e in method.estimates.items()}
    return replace(method, estimates=known)


def ranked(found: list[Change], before: Prediction, parameter: str) -> list[Change]:
    """Return the changes that help a parameter, best first."""
    helpful = [c for c in found if c.gain(before, parameter) > 1 / WORTH]
    return sorted(helpful, key=lambda c: (-c.gain(before, parameter), c.sigma(parameter)))
