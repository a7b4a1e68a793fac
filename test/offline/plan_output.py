# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What odocal plan answers, and GPX tracks for it."""

import json
import math

import numpy as np

from odocal_ros.nav.dead_reckoning import Origin
from odocal_ros.offline.cli import main

TWO_POINT = ['--set', 'method=two_point']
NAMES = ('scale_factor', 'yaw_mounting_angle', 'pitch_mounting_angle')


def plan_of(capsys, *argv):
    assert main(['plan', *argv, '--json']) == 0
    out, err = capsys.readouterr()
    assert err == ''
    return json.loads(out)


def refused(capsys, *argv):
    assert main(['plan', *argv]) == 2
    out, err = capsys.readouterr()
    assert out == ''
    assert err.count('\n') == 1
    return err


def gpx(path, times=True, rest=30.0, count=200, corner=math.pi / 2):
    """Write a track: rest, east at 10 m/s with a point a second, left as far, rest."""
    t = np.concatenate([[0.0, rest / 2], rest + np.arange(2 * count + 1), [2 * count + 2 * rest]])
    t = t[np.diff(t, prepend=-1.0) > 0]
    path_length = np.clip(t - rest, 0, 2 * count) * 10.0
    first, second = np.minimum(path_length, count * 10.0), np.maximum(path_length - count * 10.0,
                                                                      0.0)
    east, north = first + second * math.cos(corner), second * math.sin(corner)
    return gpx_of(path, t, east, north, times)


def gpx_of(path, t, east, north, times=True):
    """Write a track through points, m."""
    origin = Origin(math.radians(48.0), math.radians(11.0), 500.0)
    geodetic = origin.to_geodetic(np.stack([east, north, np.zeros_like(east)], -1))
    points = []
    for (lat, lon, height), when in zip(geodetic, t, strict=True):
        stamp = f'<time>2026-01-01T00:{int(when) // 60:02d}:{when % 60:04.1f}Z</time>'
        points.append(f'<trkpt lat="{math.degrees(lat):.9f}" lon="{math.degrees(lon):.9f}">'
                      f'<ele>{height:.2f}</ele>{stamp if times else ""}</trkpt>')
    path.write_text('<?xml version="1.0"?><gpx xmlns="http://www.topografix.com/GPX/1/1">'
                    f'<trk><trkseg>{"".join(points)}</trkseg></trk></gpx>')
    return path
