# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Detection of wheels and their side among the values of a list (joints, counters), by motion."""

from collections.abc import Sequence
from itertools import chain
from typing import Any

import numpy as np

from odocal_ros.data.arrays import Bools, Floats, Ints
from odocal_ros.data.leg import MAX_DAYS
from odocal_ros.messages.decode import Reader
from odocal_ros.messages.odometer_types import JOINTS
from odocal_ros.messages.raws import tables
from odocal_ros.nav.time_series import running_integral
from odocal_ros.offline.survey import FixPath
from odocal_ros.screening.glitches import is_impossible
from odocal_ros.settings.config import SIDES

FIELDS = {JOINTS: ('position', 'velocity'), 'std_msgs/msg/Int32MultiArray': ('data',),
          'std_msgs/msg/Int64MultiArray': ('data',)}


class ListCollector:
    """Collects all values of a topic with lists; its messages come in order."""

    def __init__(self, msgtype: str) -> None:
        self.msgtype = msgtype
        # (field, keys of its values) -> blocks of (stamps ns, arrival times ns, values)
        self._blocks: dict[tuple[str, tuple[str, ...]], list[tuple[Ints, Ints, Floats]]] = {}

    def rows(self, raws: Sequence[bytes], received_ns: Sequence[int] | Ints) -> None:
        """Store a block of messages; those that cannot be read as columns are skipped."""
        received = np.array(received_ns, np.int64)
        for layout, rows, table in tables(self.msgtype, raws):
            if layout is None:
                continue
            field = next((name for name in FIELDS[self.msgtype] if layout.count(name)), '')
            if not field:
                continue
            n = layout.count(field)
            keys = tuple(layout.names[:n]) or tuple(map(str, range(n)))
            values = layout.columns(table, [f'{field}[{k}]' for k in range(len(keys))])
            stamp = layout.columns(table, ['header.stamp.sec', 'header.stamp.nanosec'])
            stamps = received[rows] if stamp is None else (
                stamp[:, 0].astype(np.int64) * 10**9 + stamp[:, 1])
            self._blocks.setdefault((field, keys), []).append(
                (stamps, received[rows], np.array(values, float)))

    def facts(self, imu: tuple[Ints, Floats] | None = None,
              path: FixPath | None = None) -> list[dict[str, Any]]:
        """
        Return the motion of each value of the most frequent list.

        imu : stamps, ns, and the turn rate to the left, rad/s, (n,) each; None without an IMU.
        path : of the fixes; None without fixes.
        """
        if not self._blocks:
            return []
        (field, keys), blocks = max(self._blocks.items(),
                                    key=lambda entry: sum(len(block[0]) for block in entry[1]))
        stamp_ns, received_ns, value = (np.concatenate(parts) for parts in zip(
            *blocks, strict=True))
        keep = np.append(True, np.diff(stamp_ns) > 0) & ~is_impossible('value', value)
        stamp_ns, received_ns, value = stamp_ns[keep], received_ns[keep], value[keep]
        if len(stamp_ns) < 3:
            return []
        t = (stamp_ns - stamp_ns[0]) * 1e-9
        s = _travel(t, value, field)
        path_length, span = np.abs(np.diff(s, axis=0)).sum(axis=0), np.ptp(s, axis=0)
        # two turns, rad: a joint with a larger range turns without limit
        min_span = 4 * np.pi if self.msgtype == JOINTS else 0
        min_share = 0.3    # range of a wheel over the largest range of all values
        rolls = (span > min_span) & (span > min_share * span.max())
        # a joint that turns without driving, such as a lidar, is no wheel
        matches = [path.match(received_ns, travel) for travel in s.T] if path else []
        if any(match.follows for match in matches):
            rolls = np.array([match.follows for match in matches])
        scales = [match.scale if match.follows else None for match in matches] or (
            [None] * len(keys))
        sides = find_sides(t, s, rolls, imu and ((imu[0] - stamp_ns[0]) * 1e-9, imu[1]))
        unit = 'rad' if self.msgtype == JOINTS else 'counts'
        return [{'key': key, 'field': field, 'unit': unit, 'distance': float(path_length[k]),
                 'span': float(span[k]), 'rolls': bool(rolls[k]), 'side': sides[k],
                 'scale': scales[k]} for k, key in enumerate(keys)]


def _travel(t: Floats, value: Floats, field: str) -> Floats:
    """Return the travel of each of k values, (n, k), from values (n, k) at t, (n,) s."""
    if field == 'velocity':
        return running_integral(t, value)
    if field == 'position':
        inside = (np.abs(value) <= np.pi + 0.01).all(axis=0)      # angles that wrap at pi
        return np.where(inside, np.unwrap(value, axis=0), value)
    return value


def find_sides(t: Floats, s: Floats, rolls: Bools, imu: tuple[Floats, Floats] | None) -> list[str]:
    """
    Return 'left', 'right' or '' of each value, by the gyro: the outer wheel travels farther.

    t, s : (n,) s and (n, k) travel.   rolls : (k,) wheels.   imu : s, and rad/s to the left.
    """
    sides = [''] * len(rolls)
    interval = 0.5    # s, in which turn and travel are compared
    # with damaged stamps a recording may seem to last for years
    grid = np.arange(t[0], t[-1], interval) if t[-1] - t[0] < MAX_DAYS * 86400 else np.empty(0)
    if imu is None or rolls.sum() < 2 or len(grid) < 10 or len(imu[0]) < 3:
        return sides
    turn = np.diff(np.interp(grid, imu[0], running_integral(*imu)))
    turn = turn - np.median(turn)
    step = np.stack([np.diff(np.interp(grid, t, travel)) for travel in s.T])
    path_length = np.abs(step).sum(axis=1, keepdims=True)
    with np.errstate(invalid='ignore', divide='ignore'):
        step = step / path_length
    mean_step = step[rolls].mean(axis=0)
    correlation_limit = 0.5    # with the gyro; smaller: the side is unknown
    for k in np.flatnonzero(rolls):
        excess = step[k] - mean_step
        power = float(np.sqrt((excess @ excess) * (turn @ turn)))
        correlation = float(excess @ turn) / power if power else 0.0
        if abs(correlation) > correlation_limit:
            sides[k] = 'right' if correlation > 0 else 'left'
    return sides


def single_wheel_setting(facts: list[dict[str, Any]], named: Sequence[str]) -> tuple[str, ...]:
    """Return the setting for one wheel, unless all wheels ``named`` grow with the distance."""
    growing = {value['key']: value['field'] for value in facts if value['scale']}
    if not growing or named and growing.keys() >= set(named):
        return ()
    key, field = next(iter(growing.items()))
    return (f'odometer.field={field}[{key}]',)


def wheel_settings(facts: list[dict[str, Any]]) -> tuple[str, ...]:
    """Return the settings for the wheels by side; none if left and right differ in number."""
    left, right = ([value['key'] for value in facts if value['side'] == side] for side in SIDES)
    if len(left) != len(right) or not left:
        return ()
    if len(left) > 1:
        axles = chain.from_iterable(zip(left, right, strict=True))
        quoted = (f'"{key}"' if '[' in key else key for key in axles)      # for YAML
        return (f'odometer.wheels=[{", ".join(quoted)}]',)
    return tuple(f'odometer.{side}={keys[0]}' for side, keys in zip(
        SIDES, (left, right), strict=True))


def motion_texts(facts: list[dict[str, Any]]) -> list[str]:
    """Return the motion of each value as a line of text."""
    lines = []
    for value in facts:
        unit = value['unit']
        side = f'; {value["side"]} side (matches gyro)' if value['side'] else ''
        scale = f', {value["scale"]:.3g} m/{unit.rstrip("s")}' if value['scale'] else ''
        kind = f'a wheel{scale}{side}' if value['rolls'] else 'no wheel'
        lines.append(f'{value["key"]} travels {value["distance"]:.5g} {unit} in total; its '
                     f'values span {value["span"]:.5g} {unit}: {kind}')
    return lines


def list_facts(reader: Reader, values: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the facts of a topic with lists, from the motion of its values."""
    form = reader.form
    return {'values': values,
            **({'motions': motion_texts(values)} if len(values) > 1 else {}),
            **({'chosen': form.selection_text} if form and form.selection_text else {})}
