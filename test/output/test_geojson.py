# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The track in GeoJSON, and the table of legs."""

import csv
from dataclasses import replace
import io
import json

from calibration_parts import CREATED
import numpy as np
import pytest

from odocal_ros.nav.dead_reckoning import Origin
from odocal_ros.output.files import as_json
from odocal_ros.output.program_files import geojson, MAX_TRACK_POINTS, TRACK
from odocal_ros.output.tables import leg_table
from odocal_ros.settings.config import Config


@pytest.fixture
def driven(good):
    """Return an accepted calibration of a leg of 1 km to the east at 50 N, 8 E."""
    track = np.column_stack([np.linspace(0, 1000, 21), np.zeros(21), np.zeros(21)])
    return with_leg(good, origin=(*np.deg2rad([50.0, 8.0]), 200.0), track_n=track,
                    track_before_n=track * 0.9, reference_n=track[::2] + [0.0, 1.0, 0.0])


def features(calibration):
    config = Config()
    text = geojson(calibration, config, as_json(calibration, config, [], CREATED))
    return json.loads(text['track.geojson'])


def of_kind(calibration, kind):
    return [f for f in features(calibration)['features'] if f['properties']['kind'] == kind]


def with_leg(calibration, **changed):
    return replace(calibration, legs=(replace(calibration.legs[0], **changed),))


def test_the_structure_conforms_to_rfc_7946(driven):
    whole = features(driven)
    assert whole['type'] == 'FeatureCollection'
    assert 'crs' not in whole            # RFC 7946, section 4: WGS 84 and nothing else
    kinds = [(f['properties']['kind'], f['geometry']['type']) for f in whole['features']]
    assert kinds == [('corrected', 'LineString'), ('as_configured', 'LineString'),
                     ('fixes', 'MultiPoint'), ('mark', 'Point'), ('mark', 'Point')]
    for feature in whole['features']:
        assert set(feature) == {'type', 'geometry', 'properties'}
        assert feature['type'] == 'Feature'
        assert feature['properties']['leg'] == 1


def test_longitude_comes_first_and_positions_and_marks_agree_with_the_track(driven):
    from pyproj import Geod
    line = np.array(of_kind(driven, 'corrected')[0]['geometry']['coordinates'])
    assert line[0].tolist() == [8.0, 50.0, 200.0]
    # on the ellipsoid, 200 m below, it is shorter by 200 m over its radius; 1e-8 deg is 1 mm
    _, _, length = Geod(ellps='WGS84').inv(*line[0, :2], *line[-1, :2])
    assert length == pytest.approx(1000 * (1 - 200 / 6.39e6), abs=0.01)
    back = Origin(*driven.legs[0].origin).to_n(np.column_stack(
        [np.deg2rad(line[:, 1::-1]), line[:, 2]]))
    assert np.abs(back - driven.legs[0].track_n).max() < 2e-3
    start, stop = of_kind(driven, 'mark')
    line = of_kind(driven, 'corrected')[0]['geometry']['coordinates']
    assert start['geometry']['coordinates'] == line[0]
    assert stop['geometry']['coordinates'] == line[-1]
    assert stop['properties'] | {'mark': 'stop', 'stamp_ns': driven.legs[0].stop_ns} \
        == stop['properties']


def test_fixes_without_a_height_have_two_coordinates(driven):
    flat = driven.legs[0].reference_n.copy()
    flat[3, 2] = np.nan
    fixes, = of_kind(with_leg(driven, reference_n=flat), 'fixes')
    assert {len(p) for p in fixes['geometry']['coordinates']} == {2}


def test_a_line_across_the_180th_meridian_is_cut_there(driven):
    track = driven.legs[0].track_n + [0.0, 0.0, 5.0]
    track[:, 1] = track[:, 0]           # to the north-east
    there = with_leg(driven, origin=(*np.deg2rad([-17.0, 179.9952]), 0.0), track_n=track)
    line = of_kind(there, 'corrected')[0]['geometry']
    assert line['type'] == 'MultiLineString'
    west, east = (np.array(piece) for piece in line['coordinates'])
    assert west[-1, 0] == 180.0
    assert east[0, 0] == -180.0
    assert west[-1, 1:].tolist() == east[0, 1:].tolist()
    assert (west[:, 0] > 179).all()
    assert (east[:, 0] < -179).all()
    assert len(west) + len(east) == 21 + 2
    # the cut is on the line: its latitude is interpolated by longitude, to the stored digits
    share = (180.0 - west[-2, 0]) / (east[1, 0] + 360.0 - west[-2, 0])
    assert 0.1 < share < 0.9
    assert west[-1, 1] == pytest.approx(west[-2, 1] + share * (east[1, 1] - west[-2, 1]), abs=2e-8)


def test_the_points_of_a_long_leg_are_thinned_and_counted(driven):
    rows = np.zeros((MAX_TRACK_POINTS * 3, 3))
    rows[:, 0] = np.arange(len(rows))
    fixes, = of_kind(with_leg(driven, reference_n=rows), 'fixes')
    assert len(fixes['geometry']['coordinates']) == MAX_TRACK_POINTS
    assert fixes['properties']['points'] == MAX_TRACK_POINTS
    assert fixes['properties']['of'] == MAX_TRACK_POINTS * 3


def test_without_a_track_there_is_no_file(good):
    assert geojson(good, Config(), as_json(good, Config(), [], CREATED)) == {}


def rows_of(calibration):
    text = leg_table(calibration, Config(), as_json(calibration, Config(), [], CREATED))
    return list(csv.DictReader(io.StringIO(text['legs.csv'])))


def test_the_table_has_one_row_per_leg_and_units_in_the_header(good, nothing):
    lost = replace(nothing.legs[0], bag='a, "b"')
    first, second = rows_of(replace(good, legs=(good.legs[0], lost)))
    assert (first['leg'], second['leg'], second['bag']) == ('1', '2', 'a, "b"')
    assert float(first['scale_factor [m/pulse]']) == 0.05
    assert float(first['scale_factor_sigma [m/pulse]']) == 1.2e-6
    assert float(first['yaw_mounting_angle [rad]']) == -0.0174533
    assert first['pitch_mounting_angle [rad]'] == ''
    assert first['start [UTC]'] == '2018-08-02T08:53:20Z'
    assert first['start [ns]'] == '1533200000500000000'
    assert float(first['distance [m]']) == 11200.3
    assert float(first['after_rms [m]']) == 0.1
    assert first['reasons'] == 'TOPIC_GAP PITCH_NOT_DETERMINED'
    assert second['scale_factor [m/pulse]'] == second['after_rms [m]'] == ''
    assert (second['verdict'], second['reasons']) == ('rejected', 'NO_FIX')


def test_the_table_has_each_value_of_the_method_used_for_the_result(good):
    leg = good.legs[0]
    other = replace(leg.methods['two_point'], name='smoother', estimates={
        'yaw_mounting_angle': replace(good.estimates['yaw_mounting_angle'], value=0.5)})
    both = replace(leg, methods=leg.methods | {'smoother': other})
    estimates = good.estimates | {'yaw_mounting_angle': replace(
        good.estimates['yaw_mounting_angle'], method='smoother')}
    row, = rows_of(replace(good, legs=(both,), estimates=estimates))
    assert float(row['yaw_mounting_angle [rad]']) == 0.5
    assert float(row['scale_factor [m/pulse]']) == 0.05


def test_a_file_of_many_legs_stays_small(good):
    track_n = np.zeros((MAX_TRACK_POINTS, 3))
    leg = replace(good.legs[0], origin=(0.7, 0.2, 100.0), track_n=track_n, track_before_n=track_n,
                  reference_n=track_n)
    sizes = []
    for count in (10, 100):
        whole = replace(good, legs=(leg,) * count)
        sizes.append(len(geojson(whole, Config(), {'software': '', 'created': ''})[TRACK]))
    assert sizes[1] < 1.3 * sizes[0]
