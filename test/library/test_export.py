# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Each exported file, read by its own program or checked by its format specification."""

import csv
import operator
import re
from xml.etree import ElementTree

import layout_names
import numpy as np
from pyproj import Geod
import pytest
from rosbags.highlevel import AnyReader

from odocal_ros import OdocalError
from odocal_ros.library.export import KNOWN
from odocal_ros.library.export_pictures import map_figure
from odocal_ros.offline.cli import main
from odocal_ros.output.program_files import features


@pytest.fixture(scope='module')
def exported(calibration, tmp_path_factory):
    """Write all formats that need no other package."""
    folder = tmp_path_factory.mktemp('exported')
    calibration.export(*(folder / name for name in KNOWN
                         if not name.endswith(('.parquet', '.rrd'))))
    return folder


def test_tum_has_the_format_that_evo_reads(calibration, exported):
    """evo: eight entries a row by single spaces, seconds first, a quaternion x y z w last."""
    found = calibration.trajectory()
    text = (exported / 'trajectory.tum').read_text()
    lines = [line for line in text.splitlines() if not line.startswith('#')]
    assert all(len(line.split(' ')) == 8 for line in lines)
    rows = np.array([line.split(' ') for line in lines], float)
    np.testing.assert_allclose(rows[:, 1], found['east_m'], rtol=1e-8)
    np.testing.assert_allclose(np.linalg.norm(rows[:, 4:], axis=1), 1.0, rtol=1e-7)
    stamps = [int(s.replace('.', '')) for s in re.findall(r'^(\d+\.\d{9}) ', text, re.MULTILINE)]
    assert stamps == found['stamp_ns'].tolist()


def test_evo_reads_the_tum_file(calibration, exported):
    files = pytest.importorskip('evo.tools.file_interface', reason='no evo: pip install ".[dev]"')
    found = files.read_tum_trajectory_file(str(exported / 'trajectory.tum'))
    whole, details = found.check()
    assert whole, details
    pose = calibration.trajectory()
    steps = np.diff([pose['east_m'], pose['north_m'], pose['up_m']], axis=1)
    assert found.path_length == pytest.approx(np.linalg.norm(steps, axis=0).sum(), rel=1e-6)


@pytest.mark.parametrize('name', ['trajectory', 'states', 'residuals'])
def test_csv_contains_all_digits(calibration, exported, name):
    with (exported / f'{name}.csv').open(newline='') as file:
        rows = list(csv.DictReader(file))
    for column, values in getattr(calibration, name)().items():
        np.testing.assert_array_equal(
            np.array([row[column] for row in rows]).astype(values.dtype), values)


def test_parquet_contains_all_digits(calibration, tmp_path):
    parquet = pytest.importorskip('pyarrow.parquet', reason='pip install pandas pyarrow')
    calibration.export(tmp_path / 'residuals.parquet')
    table = parquet.read_table(tmp_path / 'residuals.parquet')
    for column, values in calibration.residuals().items():
        np.testing.assert_array_equal(table[column].to_numpy(), values)


def test_kml_is_a_line_of_the_track(calibration, exported):
    """OGC 07-147r2: longitude, latitude in degrees, height in m; triples by spaces."""
    root = ElementTree.parse(exported / 'track.kml').getroot()
    space = {'k': 'http://www.opengis.net/kml/2.2'}
    assert root.tag == f'{{{space["k"]}}}kml'
    line, = root.findall('k:Document/k:Placemark/k:LineString/k:coordinates', space)
    triples = np.array([triple.split(',') for triple in line.text.split()], float)
    pose = calibration.trajectory()
    np.testing.assert_allclose(triples, np.stack(
        [pose[c] for c in ('longitude_deg', 'latitude_deg', 'height_m')], -1), atol=6e-4)
    np.testing.assert_allclose(triples[:, 1], pose['latitude_deg'], atol=6e-9)


def test_mcap_is_a_readable_bag(calibration, exported):
    with AnyReader([exported / 'debug.mcap']) as bag:
        found = {}
        for connection, stamp, raw in bag.messages():
            found.setdefault(connection.topic, []).append(
                (stamp, bag.deserialize(raw, connection.msgtype)))
    pose, bias, left = calibration.trajectory(), calibration.states(), calibration.residuals()
    stamps, fixes = zip(*found['/odocal/track'], strict=True)
    assert list(stamps) == pose['stamp_ns'].tolist()
    np.testing.assert_allclose([m.latitude for m in fixes], pose['latitude_deg'], rtol=1e-14)
    biases = [m for _, m in found['/odocal/biases']]
    np.testing.assert_array_equal([m.angular_velocity.z for m in biases], bias['gyro_bias_z'])
    for field, sensor in (('angular_velocity', 'gyro'), ('linear_acceleration', 'accelerometer')):
        variance = np.array([getattr(m, f'{field}_covariance') for m in biases])
        np.testing.assert_array_equal(variance[:, 4], bias[f'{sensor}_bias_y_sigma']**2)
    sensors = {topic.rpartition('/')[2] for topic in found if 'residuals' in topic}
    assert sensors == set(left['sensor'])
    for sensor, joint, component in (('track', 'left_m', 'left'), ('fix', 'up_m', 'up'),
                                     ('gyro', 'z_rad_per_s', 'z'),
                                     ('accelerometer', 'x_m_per_s2', 'x')):
        stamps, rows = zip(*found[f'/odocal/residuals/{sensor}'], strict=True)
        names = list(rows[0].name)
        values = np.array([row.position for row in rows])
        one = (left['sensor'] == sensor) & (left['component'] == component)
        assert list(stamps) == left['stamp_ns'][one].tolist()
        np.testing.assert_array_equal(values[:, names.index(joint)], left['value'][one])
        sigma = joint.replace('_', '_sigma_', 1)
        np.testing.assert_array_equal(values[:, names.index(sigma)], left['sigma'][one])


def test_foxglove_layout_shows_topics_of_the_mcap(exported):
    layout = layout_names.foxglove('odocal_result_foxglove.json')['configById']
    topics, drawn = set(layout['map!track']['topicColors']), {}
    for panel in layout.values():
        for path in panel.get('paths', ()):
            topic, _, field = path['value'].partition('.')
            drawn.setdefault(topic, []).append((field, path['label']))
    with AnyReader([exported / 'debug.mcap']) as bag:
        assert topics | set(drawn) <= set(bag.topics)
        for link in [c for c in bag.connections if c.topic in drawn]:
            _, _, raw = next(bag.messages([link]))
            message = bag.deserialize(raw, link.msgtype)
            for field, label in drawn[link.topic]:
                if number := re.fullmatch(r'position\[(\d+)]', field):
                    assert message.name[int(number[1])].startswith(f'{label}_')
                    assert 'sigma' not in message.name[int(number[1])]
                else:
                    assert np.isfinite(operator.attrgetter(field)(message))


def test_the_map_has_one_scale_and_a_correct_scale_bar(calibration, exported):
    """The bar against the geodesic on the ellipsoid; a degree of both axes in metres a pixel."""
    figure = map_figure(features(1, calibration.result.legs[0], 400))
    ax, = figure.axes
    bar = next(line for line in ax.lines if line.get_linewidth() == 3)
    length, unit = ax.texts[0].get_text().split()
    (west, east), south = bar.get_xdata(), bar.get_ydata()[0]
    metres = Geod(ellps='WGS84').inv(west, south, east, south)[2]
    assert metres == pytest.approx(float(length) * {'m': 1, 'km': 1000}[unit], rel=1e-3)
    corner, along, up = ax.transData.transform([(west, south), (east, south),
                                                (west, south + east - west)])
    north = Geod(ellps='WGS84').inv(west, south, west, south + east - west)[2]
    assert metres / (along - corner)[0] == pytest.approx(north / (up - corner)[1], rel=0.01)
    track = next(line for line in ax.lines if line.get_label() == 'corrected')
    pose = calibration.trajectory()
    assert np.ptp(track.get_ydata()) == pytest.approx(np.ptp(pose['latitude_deg']), rel=0.01)
    assert b'corrected' in (exported / 'map.svg').read_bytes()


def test_rerun_reads_what_was_written(calibration, tmp_path):
    chunks = pytest.importorskip('rerun.chunk', reason='no rerun: pip install rerun-sdk')
    calibration.export(tmp_path / 'drive.rrd')
    found = {chunk.entity_path: chunk
             for chunk in chunks.RrdReader(tmp_path / 'drive.rrd').stream()}
    pose, state = calibration.trajectory(), calibration.states()
    assert {name.rpartition('/')[2] for name in found if '/states/' in name} == {
        *state} - {'leg', 'stamp_ns', 't_s'}
    table = found['/leg_1/states/gyro_bias_z'].to_record_batch().to_pydict()
    stamps = np.array([t.value for t in table['time']])
    np.testing.assert_array_equal(stamps, pose['stamp_ns'])
    values, = (column for name, column in table.items() if name.startswith('Scalars'))
    np.testing.assert_array_equal(np.ravel(values), state['gyro_bias_z'])
    assert found['/leg_1/track'].is_static
    assert found['/leg_1/map'].is_static


def test_the_command_writes_exports_next_to_the_results(town, tmp_path, capsys):
    out = tmp_path / 'out'
    argv = ['replay', str(town[1]), '--method', 'two_point', '--leg', '0:', '--output', str(out)]
    assert main([*argv, '--export', 'residual.csv']) == 2
    error = capsys.readouterr().err
    assert 'did you mean residuals.csv? required: one of traj' in error
    assert not out.exists()
    assert main([*argv, '--export', 'residuals.csv,track.kml', '--export', 'trajectory.csv']) == 2
    assert 'no leg has a result of the smoother' in capsys.readouterr().err
    assert (out / 'calibration.json').exists()
    assert (out / 'residuals.csv').exists()


def test_without_pyarrow_the_error_states_how_to_install_it(calibration, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__('sys').modules, 'pyarrow', None)
    with pytest.raises(OdocalError, match=r'pip install pandas pyarrow'):
        calibration.export(tmp_path / 'residuals.parquet')
    assert not list(tmp_path.iterdir())
    monkeypatch.setitem(__import__('sys').modules, 'rerun', None)
    with pytest.raises(OdocalError, match=r'pip install rerun-sdk'):
        calibration.export(tmp_path / 'drive.rrd')


def test_the_scale_against_speed_is_a_table_and_a_picture(calibration, exported):
    with (exported / 'scale_by_speed.csv').open(newline='') as file:
        rows = list(csv.DictReader(file))
    leg = calibration.result.legs[0].evidence.by_speed
    assert [float(row['ratio']) for row in rows] == leg.bins[:, 1].tolist()
    assert {(float(row['offset_m_per_s']), float(row['lag_s'])) for row in rows} == {
        (leg.offset[0], leg.lag[0])}
    assert (exported / 'scale_by_speed.png').read_bytes().startswith(b'\x89PNG')
    assert b'<svg' in (exported / 'scale_by_speed.svg').read_bytes()
