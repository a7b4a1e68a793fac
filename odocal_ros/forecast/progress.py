# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Progress of a drive for the operator: distance, speed, standstill, clocks that differ."""

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
STANDING_S = 0.5            # judgement: without a count for this time, the vehicle is at rest
SHORTEST_REST_NS = 10**9    # judgement: a shorter pause is no standstill


class Clocks:
    """
    Compares stamps of rows that arrive together: finds clocks that differ from the IMU's.

    simulated : arrivals are times of the node's clock at reception, not at sending.
    """

    def __init__(self, simulated: bool = False) -> None:
        self._simulated = simulated
        # arrivals and stamps of IMU blocks; arrival and stamp of the newest row of other topics,
        # until a later IMU block arrives
        self._imu: deque[tuple[Ints, Ints]] = deque(maxlen=IMU_BLOCKS)
        self._waiting: dict[str, tuple[int, int]] = {}
        self._leads_s: dict[str, deque[float]] = {}      # of the stamps over those of the IMU

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
        # messages that queue for a node in simulated time arrive late, those of the IMU more than
        # others: then it is not known which of them belong together
        queued = self._simulated and np.ptp(received - stamps) > CLOCK_DIFFERENCE_LIMIT * 1e9
        for name, (arrival_ns, stamp_ns) in list(self._waiting.items()):
            arrival = arrival_ns - first_received
            if arrival > received.max():
                continue
            del self._waiting[name]
            if arrival >= received.min() and not queued:
                lead_s = (stamp_ns - first_stamp - np.interp(arrival, received, stamps)) * 1e-9
                self._leads_s.setdefault(name, deque(maxlen=CLOCK_ROWS)).append(float(lead_s))

    def differing(self, config: Config) -> list[tuple[str, float]]:
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
    days = seconds / (DAY_NS * 1e-9)
    return f'{seconds:.3g} s' if days < 2 else f'{days:.0f} days'


def scale_so_far(config: Config, form: OdometerForm | None, estimated: float = np.nan) -> float:
    """Return m per unit of the odometer, by the best value so far; 0 if unknown."""
    if np.isfinite(estimated) and estimated > 0:
        return float(estimated)
    if form is None:
        return config.odometer.nominal_scale
    return nominal_scale(config, form.scale_unit)


class OdometerProgress:
    """Distance, speed and standstill from odometer blocks, in odometer units."""

    def __init__(self, form: OdometerForm) -> None:
        self.form = form
        self.total = 0.0         # path length
        self.moved_ns = 0        # stamp of the last motion
        self.newest_ns = 0
        self.top = 0.0           # highest speed, units/s
        self._rows = StepReader(form)
        self._moved_total = 0.0  # path length at the last motion
        self._rest = 0.0, 0      # length, s, and end of the last standstill
        self._since = 0.0, 0     # path length and stamp from which a speed is computed

    def feed(self, block: OdometerSamples, scale: float) -> None:
        """Take a block; scale: m per unit, 0 unknown."""
        steps, stamps, seconds = self._rows.read(block)
        if not len(steps):
            return
        if scale > 0:
            steps = np.where(np.abs(steps) * scale > FASTEST * np.maximum(seconds, 0.01), 0, steps)
        path = self.total + np.cumsum(np.abs(steps))
        for total, stamp in zip(path, stamps, strict=True):
            if total - self._moved_total > self._rows.rest_travel:
                rest_ns = int(stamp) - self.moved_ns if self.moved_ns else 0
                if rest_ns > SHORTEST_REST_NS:
                    self._rest = rest_ns * 1e-9, int(stamp)
                self._moved_total, self.moved_ns = total, int(stamp)
        self.newest_ns, self.total = int(stamps[-1]), float(path[-1])
        self.moved_ns = min(self.moved_ns or int(stamps[0]), self.newest_ns)  # a clock set back
        before, since_ns = self._since
        if abs(self.newest_ns - since_ns) >= SPEED_SPAN_NS:    # rows of a burst give no speed
            if since_ns:
                self.top = max(self.top, (self.total - before) * 1e9 / (self.newest_ns - since_ns))
            self._since = self.total, self.newest_ns

    def still_s(self) -> float:
        """Return the time since the last motion, s; 0 before the first row."""
        return (self.newest_ns - self.moved_ns) * 1e-9 if self.moved_ns else 0.0

    def rested_s(self, since_s: float) -> float:
        """Return the longer of the current standstill and one that ended within since_s, s."""
        last_s, end_ns = self._rest
        is_recent = self.newest_ns - end_ns < since_s * 1e9
        return max(self.still_s(), last_s if is_recent else 0.0)


class FixPath:
    """Path length of the fixes while the odometer moves; steps below the noise are ignored."""

    def __init__(self) -> None:
        self.total = self.top = 0.0      # m, m/s
        self._anchor: tuple[float, float, int] | None = None      # rad, rad, stamp

    def feed(self, block: FixSamples, min_status: int, moving: bool) -> None:
        """Take a block of fixes; moving: by the odometer."""
        for lat, lon, stamp, variance, status in zip(
                block.latitude, block.longitude, block.stamp_ns,
                block.covariance_n[:, 0, 0], block.status, strict=True):
            if status < min_status or not (abs(lat) <= np.pi / 2 and abs(lon) <= 2 * np.pi):
                continue        # also NaN
            if self._anchor is None or not moving:
                self._anchor = (lat, lon, stamp)
                continue
            meridian, normal = radii(lat)
            step = np.hypot((lat - self._anchor[0]) * meridian,
                            (lon - self._anchor[1]) * normal * np.cos(lat))
            elapsed_ns = stamp - self._anchor[2]
            noise = 3 * np.sqrt(variance) if variance > 0 else 0.0
            if step > max(3.0, noise) and elapsed_ns >= SPEED_SPAN_NS:
                self.total += float(step)
                self.top = max(self.top, float(step) * 1e9 / elapsed_ns)
                self._anchor = (lat, lon, stamp)


class Progress:
    """Distance, speed, standstill and clocks of one node; ``begin_leg`` resets the first two."""

    def __init__(self, simulated: bool = False) -> None:
        self.clocks = Clocks(simulated)
        self._travel: OdometerProgress | None = None
        self._path = FixPath()
        self._start_total = 0.0                # odometer path at the start of the leg
        self._scale = 0.0                      # m per unit of the odometer, 0: unknown
        self._last: dict[str, Any] = {}        # slot -> newest block

    def feed(self, slot: str, block: Any, config: Config, form: OdometerForm | None,
             found_scale: float) -> None:
        """Take a block; found_scale: m per odometer unit by an earlier result, or NaN."""
        if not len(block.stamp_ns):
            return
        self.clocks.feed(slot, block)
        self._last[slot] = block
        if slot == 'odometer' and form is not None:
            self._scale = scale_so_far(config, form, found_scale)
            self._travel = self._travel or OdometerProgress(form)
            self._travel.feed(block, self._scale)
        elif slot == 'fix':
            moving = bool(self._travel and self._travel.moved_ns) and self.still_s() < STANDING_S
            self._path.feed(block, config.gnss.min_status, moving)

    def received_before(self, preroll_s: float) -> Received:
        """Return the contents of the samples so far that determine what a leg can estimate."""
        fix, imu = self._last.get('fix'), self._last.get('imu')
        position: dict[str, Any] = {}
        if fix is not None and np.isfinite(fix.latitude[-1]):
            position = {'latitude': float(fix.latitude[-1]),
                        'height': bool(np.isfinite(fix.height[-1]))}
        variances = {name: stated_variance(self._last[slot]) if slot in self._last else np.inf
                     for slot, name in (('heading', 'heading_topic'), ('imu', 'imu_orientation'))}
        return Received(variances, **position,
                        has_accelerometer=imu is None or has_accelerometer(imu.f_i),
                        rested_s=self._travel.rested_s(preroll_s) if self._travel else 0.0)

    def begin_leg(self) -> None:
        """Restart distance and highest speed."""
        self._path = FixPath()
        if self._travel is not None:
            self._start_total, self._travel.top = self._travel.total, 0.0

    def distance_m(self) -> float:
        """Return the distance of the leg so far: odometer where its scale is known, else fixes."""
        if self._travel is not None and self._scale > 0:
            return (self._travel.total - self._start_total) * self._scale
        return self._path.total

    def max_speed(self) -> float:
        """Return the highest speed of the leg so far, m/s, over a second or more."""
        if self._travel is not None and self._scale > 0:
            return self._travel.top * self._scale
        return self._path.top

    def still_s(self) -> float:
        """Return the time since the last motion of the odometer, s."""
        return self._travel.still_s() if self._travel else 0.0
