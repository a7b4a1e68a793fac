# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Time series of a calibration as files of other programs: evo, tables, maps, PlotJuggler."""

from collections.abc import Callable, Iterable
from importlib.util import find_spec
from pathlib import Path
import tempfile
from typing import Any

import numpy as np

from odocal_ros.bagio import encode
from odocal_ros.bagio.write import write_bag
from odocal_ros.calib.result import Calibration
from odocal_ros.data.samples import FixSamples, ImuSamples, OdometerSamples
from odocal_ros.errors import BadUsage, unknown_name
from odocal_ros.library import export_pictures, series
from odocal_ros.library.calibration import TABLES_INSTALL
from odocal_ros.output.plot_style import PICTURES
from odocal_ros.safe_io.atomic_files import whole_file

# package and error text by the ending of files that need it
REQUIRED = {'.parquet': ('pyarrow', f'Parquet needs pyarrow: {TABLES_INSTALL}'),
            '.rrd': ('rerun', 'a recording of Rerun needs rerun-sdk: pip install rerun-sdk')}
UNIT_NAMES = {'m': 'm', 'rad/s': 'rad_per_s', 'm/s^2': 'm_per_s2'}     # in names of joints


def write_rrd(result: Calibration, path: Path) -> None:
    """
    Write drive.rrd.

    leg_N/track LineStrips3D, m in the leg's n; leg_N/map GeoLineStrings; leg_N/vehicle Transform3D
    over time; leg_N/states/NAME Scalars over time, names and units as in states.csv.
    """
    import rerun
    recording = rerun.RecordingStream('odocal_ros')
    memory = recording.memory_recording()
    pose, state = series.trajectory(result), series.states(result)
    for leg in np.unique(pose['leg']).tolist():
        _log_leg(recording, f'leg_{leg}', *(
            {name: column[columns['leg'] == leg] for name, column in columns.items()}
            for columns in (pose, state)))
    with whole_file(path) as file:
        file.write(memory.drain_as_bytes())


def _log_leg(recording: Any, name: str, pose: series.Series, state: series.Series) -> None:
    """Log the series of one leg under a name."""
    import rerun
    track_n = np.stack([pose[f'{axis}_m'] for axis in ('east', 'north', 'up')], -1)
    rotations = np.stack([pose[f'q{axis}'] for axis in 'xyzw'], -1)
    lat_lon_deg = np.stack([pose['latitude_deg'], pose['longitude_deg']], -1)
    rerun.log(f'{name}/track', rerun.LineStrips3D([track_n]), static=True, recording=recording)
    rerun.log(f'{name}/map', rerun.GeoLineStrings(lat_lon=[lat_lon_deg]), static=True,
              recording=recording)
    times = [rerun.TimeColumn('time', timestamp=pose['stamp_ns'].astype('datetime64[ns]'))]
    rerun.send_columns(f'{name}/vehicle', times, rerun.Transform3D.columns(
        translation=track_n, quaternion=rotations), recording=recording)
    for quantity, column in state.items():
        if quantity not in ('leg', 'stamp_ns', 't_s'):
            rerun.send_columns(f'{name}/states/{quantity}', times, rerun.Scalars.columns(
                scalars=column), recording=recording)


def tum_text(columns: series.Series) -> str:
    """Return poses in the format of evo: s, m, quaternion x y z w, separated by spaces."""
    stamp = columns['stamp_ns']
    rows = zip(*(columns[name] for name in (
        'east_m', 'north_m', 'up_m', 'qx', 'qy', 'qz', 'qw')), strict=True)
    return '# timestamp tx ty tz qx qy qz qw\n' + ''.join(
        f'{s // 10**9}.{s % 10**9:09d} {" ".join(f"{x:.9g}" for x in row)}\n'
        for s, row in zip(stamp.tolist(), rows, strict=True))


def csv_text(columns: series.Series) -> str:
    """Return a series as CSV text with a header line, numbers in full."""
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    return ','.join(columns) + '\n' + ''.join(f'{",".join(map(str, row))}\n' for row in rows)


def kml_text(columns: series.Series) -> str:
    """Return the track of each leg as a line on the ground, for Google Earth."""
    if np.isnan(columns['latitude_deg']).all():
        raise BadUsage(f'export: track.kml: {export_pictures.NOT_ON_A_MAP}')
    placemarks = ''
    for leg in np.unique(columns['leg']).tolist():
        rows = columns['leg'] == leg
        coordinates = ' '.join(
            f'{longitude:.8f},{latitude:.8f},{height:.3f}' for longitude, latitude, height in zip(
                *(columns[name][rows] for name in ('longitude_deg', 'latitude_deg', 'height_m')),
                strict=True))
        placemarks += (f'<Placemark><name>leg {leg}</name><LineString><tessellate>1</tessellate>'
                       f'<coordinates>{coordinates}</coordinates></LineString></Placemark>')
    return ("<?xml version='1.0' encoding='UTF-8'?>\n"
            f'<kml xmlns="http://www.opengis.net/kml/2.2"><Document>{placemarks}</Document>'
            '</kml>\n')


def write_parquet(columns: series.Series, path: Path) -> None:
    """Write a series as a Parquet file."""
    import pyarrow
    from pyarrow import parquet
    with whole_file(path) as file:
        parquet.write_table(pyarrow.table(columns), pyarrow.PythonFile(file, mode='w'))


def write_mcap(result: Calibration, path: Path) -> None:
    """
    Write all series as one mcap file, for PlotJuggler and Foxglove.

    /odocal/track NavSatFix, PoseStamped in a local frame; /odocal/biases IMU: the vehicle's
    attitude, the biases in the fields of rates and forces, and their variances;
    /odocal/residuals/SENSOR JointState: each component and its sigma, units in the names.
    """
    with tempfile.TemporaryDirectory(prefix='.odocal_', dir=path.parent) as work:
        next(write_bag(Path(work) / 'debug', _topics(result)).glob('*.mcap')).replace(path)


def _topics(result: Calibration) -> list[encode.Topic]:
    """Return the topics of ``write_mcap``."""
    pose, state = (_by_time(series_of(result)) for series_of in (series.trajectory, series.states))
    t, n = pose['stamp_ns'], len(pose['stamp_ns'])
    zeros = np.zeros(n, np.int64)
    (gyro, gyro_sigma), (force, force_sigma) = (
        [np.stack([state[f'{sensor}_bias_{axis}{ending}'] for axis in 'xyz'], -1)
         for ending in ('', '_sigma')] for sensor in ('gyro', 'accelerometer'))
    track = FixSamples(t, t, np.deg2rad(pose['latitude_deg']), np.deg2rad(pose['longitude_deg']),
                       pose['height_m'], np.zeros((n, 3, 3)), zeros, zeros)
    biases = ImuSamples(t, t, gyro, force, np.stack(
        [pose[q] for q in ('qx', 'qy', 'qz', 'qw')], -1), np.zeros(n))
    track_n = np.stack([pose[f'{axis}_m'] for axis in ('east', 'north', 'up')], -1)
    return [encode.pose('/odocal/track', track, track_n, 'odocal_enu')
            if np.isnan(track.latitude).all() else encode.fix('/odocal/track', track, 'base_link'),
            encode.imu('/odocal/biases', biases, 'base_link', gyro_sigma**2, force_sigma**2),
            *_residual_topics(result)]


def _residual_topics(result: Calibration) -> list[encode.Topic]:
    """Return a topic for each sensor, with its residuals in all legs."""
    legs_of_sensor: dict[str, list[series.LegSeries]] = {}
    for number, leg in enumerate(result.legs, 1):
        for residual in series.sensor_residuals(leg):
            legs_of_sensor.setdefault(residual.sensor, []).append(
                series.LegSeries(number, leg, _component_columns(residual)))
    topics = []
    for sensor, legs in legs_of_sensor.items():
        rows = _by_time(series.stack_legs(legs))
        topics.append(encode.joints(f'/odocal/residuals/{sensor}', {
            name: OdometerSamples(rows['stamp_ns'], rows['stamp_ns'], column)
            for name, column in rows.items() if name not in ('leg', 'stamp_ns', 't_s')}))
    return topics


def _component_columns(residual: series.SensorResiduals) -> series.Series:
    """Return the residuals of a sensor as columns: each component, then its sigma."""
    columns, unit = {'t': residual.t}, UNIT_NAMES[residual.unit]
    for name, value, sigma in zip(residual.components, residual.value.T, residual.sigma.T,
                                  strict=True):
        columns |= {f'{name}_{unit}': value.astype(float),
                    f'{name}_sigma_{unit}': sigma.astype(float)}
    return columns


def _by_time(columns: series.Series) -> series.Series:
    """Return a series in order of its stamps: legs may overlap or be out of order."""
    order = np.argsort(columns['stamp_ns'], kind='stable')
    return {name: column[order] for name, column in columns.items()}


SERIES: dict[str, Callable[[Calibration], series.Series]] = {
    'trajectory': series.trajectory, 'track': series.trajectory, 'states': series.states,
    'residuals': series.residuals, 'scale_by_speed': export_pictures.scale_by_speed}
TEXTS = {'tum': tum_text, 'csv': csv_text, 'kml': kml_text}
# names of files that ``export`` writes
KNOWN = ('trajectory.tum', 'track.kml', 'debug.mcap', 'drive.rrd', *(
    f'{name}.{ending}' for name in ('trajectory', 'states', 'residuals', 'scale_by_speed')
    for ending in ('csv', 'parquet')), *(f'{name}{ending}' for name in ('scale_by_speed', 'map')
                                         for ending in PICTURES))


def check_names(files: Iterable[Path | str]) -> None:
    """Raise BadUsage for a file with an unknown name, or without a library to write it."""
    for file in map(Path, files):
        package, text = REQUIRED.get(file.suffix, ('', ''))
        if package and find_spec(package) is None:
            raise BadUsage(f'export: {file}: {text}')
        if file.name not in KNOWN:
            raise BadUsage(f'export: {file}: {unknown_name(file.name, KNOWN)}')


def export(result: Calibration, files: Iterable[Path | str]) -> list[Path]:
    """
    Write series as files; their names select series and format: ``KNOWN``.

    Raises BadUsage: a name is unknown, no leg has such a series, a file cannot be written.
    """
    paths = [Path(file) for file in files]
    check_names(paths)
    for file in paths:
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            _write(result, file)
        except OSError as error:
            raise BadUsage(f'{file}: cannot be written ({error.strerror or error})') from None
    return paths


def _write(result: Calibration, file: Path) -> None:
    """Write the file that a name of KNOWN selects."""
    name, ending = file.stem, file.suffix[1:]
    if file.suffix in PICTURES:
        draw = export_pictures.draw_map if name == 'map' else export_pictures.draw_scale_by_speed
        draw(result, file)
    elif ending == 'mcap':
        write_mcap(result, file)
    elif ending == 'rrd':
        write_rrd(result, file)
    elif ending == 'parquet':
        write_parquet(SERIES[name](result), file)
    else:
        with whole_file(file) as output:
            output.write(TEXTS[ending](SERIES[name](result)).encode())
