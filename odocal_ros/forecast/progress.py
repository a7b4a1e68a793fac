# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Progress of a drive, from received blocks: distance, speed, standstill, differing clocks."""

from collections import deque
from typing import Any

import numpy as np

from odocal_ros.data.arrays import Ints
from odocal_ros.data.samples import FixSamples, OdometerForm, OdometerSamples, Samples
from odocal_ros.forecast.quantities import Received, stated_variance
from odocal_ros.nav.geodesy import radii
from odocal_ros.screening.clocks import clock_remedy, stamp_offsets
from odocal_ros.screening.leg_kind import has_accelerometer
from odocal_ros.screening.odometer_rows import StepReader
from odocal_ros.settings.config import Config
from odocal_ros.settings.levels import CLOCK_DIFFERENCE_LIMIT, DAY_NS, FASTEST
from odocal_ros.settings.nominal import nominal_scale

IMU_BLOCKS = 40       # judgement: newest IMU blocks to compare other topics with: some seconds
CLOCK_ROWS = 10       # judgement: newest rows of a topic that determine its clock
SPEED_SPAN_NS = 10**9       # judgement: minimum time over which a speed is computed
STANDING_S = 0.5            # judgement: the vehicle is at rest if no count came for this time
SHORTEST_REST_NS = 10**9    # judgement: a shorter pause is no standstill


class Clocks:
    """
    Finds clocks that differ from the IMU's, by the stamps of rows that arrive together.

    is_simulated : arrivals are times of the node's clock at reception, not at sending.
    """

    def __init__(self, is_simulated: bool = False) -> None:
        self._is_simulated = is_simulated
        self._imu: deque[tuple[Ints, Ints]] = deque(maxlen=IMU_BLOCKS)      # arrivals, stamps
        # slot -> arrival and stamp of the newest row, until a later IMU block arrives
        self._waiting: dict[str, tuple[int, int]] = {}
        self._leads_s: dict[str, deque[float]] = {}      # slot -> its stamps minus the IMU's

    def feed(self, slot: str, block: Samples) -> None:
        """Take a block of a topic."""
        if slot != 'imu':
            self._waiting[slot] = int(block.received_ns[-1]), int(block.stamp_ns[-1])
            return
        self._imu.append((block.received_ns, block.stamp_ns))
        if not self._waiting:
            return
        received, stamps = (np.concatenate(column) for column in zip(*self._imu, strict=True))
        # relative to the first: float64 seconds since 1970 have a resolution of 238 ns
        first_received, first_stamp = int(received[0]), int(stamps[0])
        received, stamps = received - first_received, stamps - first_stamp
        # messages that queue for a node in simulated time arrive late, IMU messages more than
        # others: then it is not known which rows belong together
        queued = self._is_simulated and np.ptp(received - stamps) > CLOCK_DIFFERENCE_LIMIT * 1e9
        for name, (arrival_ns, stamp_ns) in list(self._waiting.items()):
            arrival = arrival_ns - first_received
            if arrival > received.max():
                continue
            del self._waiting[name]
            if arrival >= received.min() and not queued:
                lead_s = (stamp_ns - first_stamp - np.interp(arrival, received, stamps)) * 1e-9
                self._leads_s.setdefault(name, deque(maxlen=CLOCK_ROWS)).append(float(lead_s))

    def find_differing(self, config: Config) -> list[tuple[str, float]]:
        """Return (slot, s ahead of the IMU) of topics whose clock differs, offsets applied."""
        result = []
        for slot, leads_s in self._leads_s.items():
            offset = stamp_offsets(config)[slot]
            # latency makes a row look older: a clock is behind only if all its rows are; latency
            # of IMU rows makes others look newer: a clock is ahead if most of its rows are
            difference = max(min(max(leads_s) + offset, 0.0), float(np.median(leads_s)) + offset)
            if abs(difference) > CLOCK_DIFFERENCE_LIMIT:
                result.append((slot, difference))
        return result


def clock_difference_text(clocks: list[tuple[str, float]]) -> str:
    """Return the sentence about clocks that differ from the IMU's."""
    differences = ', '.join(
        f'{slot} stamps are {_format_difference(abs(s))} {"ahead of" if s > 0 else "behind"} '
        'the IMU stamps' for slot, s in clocks)
    return f'CLOCKS_DIFFER: {differences}. {clock_remedy(max((s for _, s in clocks), key=abs))}'


def _format_difference(seconds: float) -> str:
    """Return a clock difference in s, from two days on in days."""
    days = seconds / (DAY_NS * 1e-9)
    return f'{seconds:.3g} s' if days < 2 else f'{days:.0f} days'


class OdometerProgress:
    """Distance, speed and standstill from odometer blocks, in odometer units."""

    def __init__(self, form: OdometerForm) -> None:
        self.path_length = 0.0
        self.top_speed = 0.0            # units/s
        self.last_motion_ns = 0         # stamp
        self._newest_ns = 0             # stamp of the newest row
        self._rows = StepReader(form)
        self._path_at_motion = 0.0      # path length at the last motion
        self._last_rest = 0.0, 0        # duration, s, and end, ns, of the last standstill
        self._speed_start = 0.0, 0      # path length and stamp from which a speed is computed

    def feed(self, block: OdometerSamples, scale: float) -> None:
        """Take a block; scale: m per unit, 0 unknown."""
        steps, stamps, seconds = self._rows.read(block)
        if not len(steps):
            return
        if scale > 0:
            steps = np.where(np.abs(steps) * scale > FASTEST * np.maximum(seconds, 0.01), 0, steps)
        path = self.path_length + np.cumsum(np.abs(steps))
        for length, stamp_ns in zip(path.tolist(), stamps.tolist(), strict=True):
            if length - self._path_at_motion > self._rows.rest_travel:
                rest_ns = stamp_ns - self.last_motion_ns if self.last_motion_ns else 0
                if rest_ns > SHORTEST_REST_NS:
                    self._last_rest = rest_ns * 1e-9, stamp_ns
                self._path_at_motion, self.last_motion_ns = length, stamp_ns
        self._newest_ns, self.path_length = int(stamps[-1]), float(path[-1])
        # a clock may be set back
        self.last_motion_ns = min(self.last_motion_ns or int(stamps[0]), self._newest_ns)
        start_length, start_ns = self._speed_start
        elapsed_ns = self._newest_ns - start_ns
        if abs(elapsed_ns) >= SPEED_SPAN_NS:    # rows of a burst give no speed
            if start_ns:
                self.top_speed = max(self.top_speed,
                                     (self.path_length - start_length) * 1e9 / elapsed_ns)
            self._speed_start = self.path_length, self._newest_ns

    def still_s(self) -> float:
        """Return the time since the last motion, s; 0 before the first row."""
        return (self._newest_ns - self.last_motion_ns) * 1e-9 if self.last_motion_ns else 0.0

    def rest_s(self, max_age_s: float) -> float:
        """Return the longer of the current standstill and one that ended within max_age_s, s."""
        last_s, end_ns = self._last_rest
        is_recent = self._newest_ns - end_ns < max_age_s * 1e9
        return max(self.still_s(), last_s if is_recent else 0.0)


class FixPath:
    """Path length of the fixes while the odometer moves; steps below the noise are ignored."""

    def __init__(self) -> None:
        self.path_length, self.top_speed = 0.0, 0.0      # m, m/s
        # latitude, longitude, rad, and stamp from which the next step is measured
        self._anchor: tuple[float, float, int] | None = None

    def feed(self, block: FixSamples, min_status: int, is_moving: bool) -> None:
        """Take a block of fixes; is_moving : by the odometer."""
        for latitude, longitude, stamp, variance, status in zip(
                block.latitude, block.longitude, block.stamp_ns,
                block.covariance_n[:, 0, 0], block.status, strict=True):
            if status < min_status or not (
                    abs(latitude) <= np.pi / 2 and abs(longitude) <= 2 * np.pi):
                continue        # also NaN
            if self._anchor is None or not is_moving:
                self._anchor = latitude, longitude, stamp
                continue
            meridian, normal = radii(latitude)
            step = np.hypot((latitude - self._anchor[0]) * meridian,
                            (longitude - self._anchor[1]) * normal * np.cos(latitude))
            elapsed_ns = stamp - self._anchor[2]
            noise = 3 * np.sqrt(variance) if variance > 0 else 0.0
            if step > max(3.0, noise) and elapsed_ns >= SPEED_SPAN_NS:
                self.path_length += float(step)
                self.top_speed = max(self.top_speed, float(step) * 1e9 / elapsed_ns)
                self._anchor = latitude, longitude, stamp


class Progress:
    """Distance, speed, standstill and clocks of one node; ``begin_leg`` resets the first two."""

    def __init__(self, is_simulated: bool = False) -> None:
        self.clocks = Clocks(is_simulated)
        self._odometer: OdometerProgress | None = None
        self._fixes = FixPath()
        self._start_length = 0.0               # odometer path at the start of the leg
        self._scale = 0.0                      # m per unit of the odometer, 0: unknown
        self._last: dict[str, Any] = {}        # slot -> newest block

    def feed(self, slot: str, block: Any, config: Config, form: OdometerForm | None,
             known_scale: float) -> None:
        """Take a block; known_scale : m per odometer unit by an earlier result, or NaN."""
        if not len(block.stamp_ns):
            return
        self.clocks.feed(slot, block)
        self._last[slot] = block
        if slot == 'odometer' and form is not None:
            self._scale = known_scale if known_scale > 0 else nominal_scale(
                config, form.scale_unit)
            self._odometer = self._odometer or OdometerProgress(form)
            self._odometer.feed(block, self._scale)
        elif slot == 'fix':
            is_moving = bool(self._odometer and self._odometer.last_motion_ns
                             and self.still_s() < STANDING_S)
            self._fixes.feed(block, config.gnss.min_status, is_moving)

    def received_before(self, preroll_s: float) -> Received:
        """Return the contents of the samples so far that determine what a leg can estimate."""
        fix, imu = self._last.get('fix'), self._last.get('imu')
        position: dict[str, Any] = {}
        if fix is not None and np.isfinite(fix.latitude[-1]):
            position = {'latitude': float(fix.latitude[-1]),
                        'has_height': bool(np.isfinite(fix.height[-1]))}
        variances = {name: stated_variance(self._last[slot]) if slot in self._last else np.inf
                     for slot, name in (('heading', 'heading_topic'), ('imu', 'imu_orientation'))}
        return Received(variances, **position,
                        has_accelerometer=imu is None or has_accelerometer(imu.f_i),
                        rest_s=self._odometer.rest_s(preroll_s) if self._odometer else 0.0)

    def begin_leg(self) -> None:
        """Restart distance and highest speed."""
        self._fixes = FixPath()
        if self._odometer is not None:
            self._start_length, self._odometer.top_speed = self._odometer.path_length, 0.0

    def distance_m(self) -> float:
        """Return the distance of the leg so far: odometer where its scale is known, else fixes."""
        if self._odometer is not None and self._scale > 0:
            return (self._odometer.path_length - self._start_length) * self._scale
        return self._fixes.path_length

    def max_speed(self) -> float:
        """Return the highest speed of the leg so far, m/s, over a second or more."""
        if self._odometer is not None and self._scale > 0:
            return self._odometer.top_speed * self._scale
        return self._fixes.top_speed

    def still_s(self) -> float:
        """Return the time since the last motion of the odometer, s."""
        return self._odometer.still_s() if self._odometer else 0.0
