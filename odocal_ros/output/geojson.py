# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The legs as GeoJSON (RFC 7946): WGS 84 longitude and latitude in degrees, height in metres.

Four features a leg: the corrected track, the track as configured, the fixes, the two marks.
"""

import json
from typing import Any

import numpy as np

from odocal_ros.calib.result import Calibration, LegResult
from odocal_ros.data.arrays import Floats
from odocal_ros.nav.dead_reckoning import Origin
from odocal_ros.output.drawing import evenly
from odocal_ros.output.summary import sentence
from odocal_ros.settings.config import Config

TRACK = 'track.geojson'
MOST = 5000          # judgement: points of a feature: maps do not show more
ABOUT = ('For QGIS, Foxglove, geojson.io and other maps. corrected: dead reckoning with the '
         'calibrated values; as_configured: with the previous values; fixes: of the receiver; '
         'both tracks start at the start mark')
PLACES = 8     # judgement: 1e-8 deg: 1 mm


def geojson(calibration: Calibration, config: Config, content: dict[str, Any]) -> dict[str, str]:
    """Return file name -> text, empty if no leg has a track."""
    most_of_all = 150_000    # points of a file: it stays small with many legs
    most = max(2, min(MOST, most_of_all // (3 * max(1, len(calibration.legs)))))
    shapes = [feature for n, leg in enumerate(calibration.legs, 1)
              for feature in features(n, leg, most)]
    if not shapes:
        return {}
    whole = {'type': 'FeatureCollection', 'name': 'odocal', 'about': ABOUT,
             'software': content['software'], 'created': content['created'],
             'result': sentence(calibration), 'features': shapes}
    return {TRACK: json.dumps(whole, allow_nan=False, ensure_ascii=False) + '\n'}


def features(number: int, leg: LegResult, most: int) -> list[dict[str, Any]]:
    """Return the features of a leg, of at most ``most`` points; none in a local frame."""
    if leg.origin is None:
        return []
    out = []
    for name, rows, make in (('corrected', leg.track_n, _line),
                             ('as_configured', leg.track_before_n, _line),
                             ('fixes', leg.reference_n, lambda rows: {
                                 'type': 'MultiPoint', 'coordinates': rows.tolist()})):
        positions = _positions(rows, leg, most)
        if rows is not None and len(positions):
            out.append(_feature(make(positions), number, leg, name,
                                {'points': len(positions), 'of': len(rows)}))
    track = _positions(leg.track_n, leg, most)
    if len(track):
        for name, row, stamp_ns in (('start', 0, leg.start_ns), ('stop', -1, leg.stop_ns)):
            point = {'type': 'Point', 'coordinates': track[row].tolist()}
            out.append(_feature(point, number, leg, 'mark', {'mark': name, 'stamp_ns': stamp_ns}))
    return out


def _feature(geometry: dict[str, Any], number: int, leg: LegResult, kind: str,
             more: dict[str, Any]) -> dict[str, Any]:
    return {'type': 'Feature', 'geometry': geometry,
            'properties': {'kind': kind, 'leg': number, 'bag': leg.bag,
                           'verdict': leg.verdict.value} | more}


def _positions(rows_n: Floats | None, leg: LegResult, most: int) -> Floats:
    """Return rows of n, m, as (k, 2 or 3) longitude, latitude, deg, and height, m, if known."""
    if rows_n is None or leg.origin is None or not len(rows_n):
        return np.empty((0, 3))
    rows_n = np.array(rows_n, dtype=float)[evenly(len(rows_n), most)]
    rows_n = rows_n[np.isfinite(rows_n[:, :2]).all(axis=1)]
    level = np.isnan(rows_n[:, 2]).any()
    geodetic = Origin(*leg.origin).to_geodetic(np.nan_to_num(rows_n))
    degrees = np.rad2deg(geodetic[:, 1::-1]).round(PLACES)
    if level:
        return degrees
    height_places = 3    # mm
    return np.column_stack([degrees, geodetic[:, 2].round(height_places)])


def _line(positions: Floats) -> dict[str, Any]:
    """Return a line, cut where it crosses the 180th meridian (RFC 7946, 3.1.9)."""
    jumps = np.flatnonzero(np.abs(np.diff(positions[:, 0])) > 180)
    if len(positions) < 2:
        return {'type': 'Point', 'coordinates': positions[0].tolist()}
    if not len(jumps):
        return {'type': 'LineString', 'coordinates': positions.tolist()}
    pieces: list[list[list[float]]] = []
    begin: list[list[float]] = []
    for piece, after in zip(np.split(positions, jumps + 1), [*(jumps + 1), None], strict=True):
        end: list[list[float]] = []
        if after is not None:
            end, following = _crossing(positions[after - 1], positions[after])
        pieces.append([*begin, *piece.tolist(), *end])
        begin = [] if after is None else following
    return {'type': 'MultiLineString', 'coordinates': pieces}


def _crossing(before: Floats, after: Floats) -> tuple[list[list[float]], list[list[float]]]:
    """Return the point on the 180th meridian between two points, for either side."""
    side = 180.0 if before[0] > 0 else -180.0
    beyond = after[0] + 2 * side
    share = (side - before[0]) / (beyond - before[0])
    rest = (before[1:] + share * (after[1:] - before[1:])).round(PLACES).tolist()
    return [[side, *rest]], [[-side, *rest]]
