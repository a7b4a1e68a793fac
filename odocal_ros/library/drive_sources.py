# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Planned drives from figures, a named scenario, a GPX track or a recorded bag."""

from datetime import datetime, UTC
import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from odocal_ros.data.arrays import Floats, Ints, running_sum
from odocal_ros.errors import BadUsage
from odocal_ros.forecast.planned_drive import (
    drive_from_rates,
    DRIVE_STEP,
    PlannedDrive,
    with_marks,
)
from odocal_ros.nav.dead_reckoning import Origin
from odocal_ros.nav.rotations import arctan2
from odocal_ros.safe_io.limits import read_bytes
from odocal_ros.settings.config import Config

if TYPE_CHECKING:
    from odocal_ros.library.read_bag import JournalNotes

MAX_GPX_BYTES = 2**26        # bytes of a GPX file, judgement: a day at 1 Hz has a fifth of this
MAX_DRIVE_TIME = 36_000.0      # of a planned drive, judgement: ten hours


def from_figures(speed: float, distance: float, standstill: float, turns: int,
                 acceleration: float) -> PlannedDrive:
    """
    Return a drive of ``distance`` m between two standstills, with 90 deg turns left and right.

    speed, acceleration : m/s, m/s^2; a short drive brakes from a lower speed.   standstill : s at
    both ends.   turns : number, evenly over the section at full speed.
    """
    for flag, value in (('--speed', speed), ('--distance', distance),
                        ('--acceleration', acceleration)):
        if not (math.isfinite(value) and value > 0):
            raise BadUsage(f'{flag} {value:g}: required: a number above 0')
    if not (math.isfinite(standstill) and standstill >= 0):
        raise BadUsage(f'--standstill {standstill:g}: required: 0 s or more')
    top = min(speed, math.sqrt(distance * acceleration))
    # s, of the acceleration, and at full speed
    ramp, cruise = top / acceleration, max(0.0, distance / top - top / acceleration)
    duration = 2 * (standstill + ramp) + cruise
    max_metres = 1e6
    if distance > max_metres or duration > MAX_DRIVE_TIME:
        raise BadUsage(f'--distance {distance:g} at --speed {speed:g}: {duration / 3600:.1f} h; '
                       f'the limits are {max_metres / 1000:g} km and {MAX_DRIVE_TIME / 3600:g} h')
    turn_time = 8.0    # s of a turn of 90 deg
    if turns < 0 or turns * turn_time > cruise:
        raise BadUsage(f'--turns {turns}: the limit is {int(cruise / turn_time)}: a turn takes '
                       f'{turn_time:g} s, and this drive is at full speed for {cruise:.0f} s. Use '
                       'fewer turns or a longer --distance')
    step = max(DRIVE_STEP, duration / 20_000)
    t = np.linspace(0.0, duration, max(2, math.ceil(duration / step) + 1))
    knots = standstill + np.array([0.0, ramp, ramp + cruise, 2 * ramp + cruise])
    t = np.union1d(t, knots)        # with the knots, integration by trapezoids is exact
    rate = np.zeros_like(t)
    for k in range(turns):
        begin = standstill + ramp + (k + 1) * cruise / (turns + 1) - turn_time / 2
        rate[(t >= begin) & (t < begin + turn_time)] = (-1)**k * math.pi / 2 / turn_time
    return drive_from_rates(t, np.interp(t, knots, [0.0, top, top, 0.0]), rate,
                            latitude=math.radians(45.0))


def from_scenario(name: str, duration: float | None) -> PlannedDrive:
    """Return the drive of a simulated scenario; duration: s, None: that of the scenario."""
    from odocal_ros.sim.options import resolve, SimOptions
    from odocal_ros.sim.scenarios import motion_of
    options = resolve(SimOptions(scenario=name) if duration is None
                       else SimOptions(scenario=name, duration=duration))
    motion = motion_of(options)
    t = np.union1d(np.arange(0.0, motion.duration, max(DRIVE_STEP, motion.duration / 50_000)),
                   np.append(motion.speed.breaks, motion.duration))
    t = t[np.diff(t, prepend=-1.0) > 1e-6]
    return drive_from_rates(t, motion.speed(t), motion.yaw_rate(t), options.heading,
                            latitude=options.latitude, longitude=options.longitude,
                            height=options.height)


def from_gpx(path: Path, speed: float | None = None) -> PlannedDrive:
    """
    Return the drive along a GPX track; if it has no times, at ``speed`` m/s.

    Raises BadUsage: the file cannot be read, is no GPX, has too few points, or lacks times and no
    speed is given.
    """
    t, geodetic = _gpx_points(path)
    position_n = Origin(*geodetic[0]).to_n(geodetic)
    if t is None:
        if speed is None:
            raise BadUsage(f'{path}: the track has no times; give --speed')
        steps = np.hypot(*np.diff(position_n[:, :2], axis=0).T)
        t = running_sum(steps / speed)
    return _from_points(path, t, position_n, geodetic[0])


def _gpx_points(path: Path) -> tuple[Floats | None, Floats]:
    """Return times since the first point, s (None: none given), and (n, 3) geodetic, rad, m."""
    from xml.etree import ElementTree
    try:
        root = ElementTree.fromstring(read_bytes(Path(path), MAX_GPX_BYTES))
    except OSError as error:
        raise BadUsage(f'{path}: cannot be read ({error.strerror}); give the path of a GPX '
                       'file') from None
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise BadUsage(f'{path}: is not a GPX file ({error}); export the track again as '
                       'GPX') from None
    points = [element for element in root.iter()
              if element.tag.rpartition('}')[2] in ('trkpt', 'rtept')]
    max_points = 1_000_000
    if not 2 <= len(points) <= max_points:
        raise BadUsage(f'{path}: holds {len(points)} track points; required: 2 to '
                       f'{max_points:,}. Export a track, not waypoints')
    try:
        lat_lon_deg = [[float(p.get(name, 'nan')) for name in ('lat', 'lon')] for p in points]
        heights = np.array([float(p.findtext('{*}ele') or 'nan') for p in points])
        times = [_seconds(p.findtext('{*}time')) for p in points]
    except ValueError as error:
        raise BadUsage(f'{path}: a track point is not readable ({error}); export '
                       'the track again as GPX') from None
    lat, lon = np.deg2rad(lat_lon_deg).T
    if not (np.abs(lat) < np.pi / 2).all() or not (np.abs(lon) <= 2 * np.pi).all():
        raise BadUsage(f'{path}: the latitude or longitude of a track point is missing or out '
                       'of range; export the track again as GPX')
    known = np.isfinite(heights)
    heights = np.interp(np.arange(len(heights)), np.flatnonzero(known), heights[known]) \
        if known.any() else np.zeros(len(heights))
    return (None if None in times else np.array(times) - times[0],
            np.stack([lat, lon, heights], -1))


def _seconds(text: str | None) -> float | None:
    """Return seconds since 1970 of an ISO 8601 date, None without one."""
    if text is None:
        return None
    moment = datetime.fromisoformat(text.strip())
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def _from_points(path: Path, t: Floats, position_n: Floats, start: Floats) -> PlannedDrive:
    """Return the drive through points (n, 3), m, at times (n,), s; path: for errors."""
    rising = np.concatenate([[True], np.diff(np.maximum.accumulate(t)) > 0])
    t, points = t[rising], position_n[rising]
    used = _used_points(points, path)
    first, last = used[:-1], used[1:]      # of each step between used points
    step = points[last] - points[first]
    step_length, horizontal = np.linalg.norm(step, axis=1), np.hypot(*step[:, :2].T)
    # a slow step was mostly a stop: its motion is assigned to the interval before its last point
    mean_speed = step_length / (t[last] - t[first])
    slow_speed, slow_share = 0.3, 0.1    # m/s, of the median speed: the larger is the limit
    slow = mean_speed < max(slow_speed, slow_share * np.median(mean_speed))
    begin, end = np.where(slow, t[last - 1], t[first]), t[last]
    grid = np.arange(t[0], t[-1], max(DRIVE_STEP, (t[-1] - t[0]) / 50_000))
    if len(grid) < 2 or t[-1] - t[0] > MAX_DRIVE_TIME:
        raise BadUsage(f'{path}: the track lasts {t[-1] - t[0]:.1f} s; required: above 0 s, '
                       f'at most {MAX_DRIVE_TIME:g} s')
    step_at = np.clip(np.searchsorted(end, grid), 0, len(end) - 1)      # number of the step
    moving = (grid >= begin[step_at]) & (grid <= end[step_at])
    speed = np.where(moving, (step_length / np.maximum(end - begin, 1e-3))[step_at], 0.0)
    yaw = np.unwrap(arctan2(step[:, 1], step[:, 0]))
    middle = (begin + end) / 2
    # s: faster changes between points are noise and spacing. A rest contains the path to the next
    # used point, and loses half of this time at each end
    smoothing_time = 4.0
    window = max(1, round(smoothing_time / (grid[1] - grid[0]) / 2)) * 2 + 1
    slope_windows = 5    # odd: heights are noisier, hills longer
    latitude, longitude, height = start.tolist()
    return with_marks(
        grid, _moving_mean(speed, window), _moving_mean(np.interp(grid, middle, yaw), window),
        _moving_mean(np.interp(grid, middle, arctan2(step[:, 2], horizontal)),
                     slope_windows * window),
        latitude=latitude, longitude=longitude, height=height)


def _used_points(points: Floats, path: Path) -> Ints:
    """Return the rows of points, (n, 3) m, that are far enough from the used one before."""
    min_step = 5.0    # m: nearer points are receiver noise
    used = [0]
    for k in range(1, len(points)):
        if np.hypot(*(points[k] - points[used[-1]])[:2]) >= min_step:
            used.append(k)
    if len(used) < 2:
        raise BadUsage(f'{path}: the track never moves {min_step:g} m; give a driven track')
    return np.array(used)


def _moving_mean(x: Floats, window: int) -> Floats:
    """Return means over an odd number of rows; the end values are extended: (n,)."""
    total = running_sum(np.pad(x, window // 2, mode='edge'))
    return (total[window:] - total[:-window]) / window


def from_bag(path: Path, config: Config, topics: dict[str, str],
             journal: 'JournalNotes | None') -> tuple[PlannedDrive, dict[str, float]]:
    """Return the drive of a bag's first leg, and ``Sigmas`` arguments by its fixes and counts."""
    from odocal_ros.bagio.read import open_bag
    from odocal_ros.forecast.leg_so_far import drive_profile, fix_and_count_accuracy
    from odocal_ros.library.find_legs import find_legs, marked_legs
    from odocal_ros.library.read_bag import read_topics, readers_of
    from odocal_ros.screening.screen import screen
    with open_bag(path) as bag:
        mapping, readers = readers_of(bag, topics, config, journal)
        recorder = read_topics(bag, mapping, readers)
        start_ns, stop_ns = find_legs(recorder, bag, [], marked_legs(bag), config)[0]
    inputs, _ = screen(recorder.close(start_ns, stop_ns, config.leg.preroll), config)
    return drive_profile(inputs, config), fix_and_count_accuracy(inputs, config)
