# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The bags of a fleet, and the vehicle of each."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
import re
import shutil
import tempfile
from typing import Any

from odocal_ros.errors import BadBag, BadUsage
from odocal_ros.fleet.rows import key_of
from odocal_ros.safe_io.text_formats import error_text

COLUMNS = ('vehicle', 'bag', 'config', 'legs', 'model', 'odometer_km')      # of a manifest
ENDINGS = ('.mcap', '.db3', '.bag')
METADATA = 'metadata.yaml'       # in the folder of a rosbag2
PATTERN_REMEDY = ("required: a regular expression with a group for the vehicle's name, such as "
                  "'fleet/(?P<vehicle>[^/]+)/'")


@dataclass(frozen=True)
class FleetBag:
    """A bag of a vehicle."""

    vehicle: str
    bag: str                            # path or URL
    model: str = ''
    odometer_km: float | None = None    # reading of the vehicle's odometer
    config: str = ''                    # parameter file, if the manifest names one
    legs: tuple[str, ...] = ()          # as --leg, if the manifest names them


def find_bags(names: list[str], vehicle_from: str | None) -> list[FleetBag]:
    """
    Return the bags of a manifest, or in folders, globs and URLs.

    vehicle_from : regular expression that is searched in the path of a bag. Its group ``vehicle``,
    else its first group, is the name of the vehicle; groups ``model`` and ``odometer_km`` are
    optional. None: the name of the bag's folder is that of the vehicle.

    Raises BadUsage: a manifest cannot be read, nothing is found, or the pattern does not match a
    path.
    """
    if len(names) == 1 and names[0].endswith(('.csv', '.parquet')):
        return _read_manifest(names[0])
    pattern = _pattern(vehicle_from) if vehicle_from else None
    bags = [_bag_of_path(bag, pattern) for name in names for bag in _bags_in(name)]
    unique = list(dict.fromkeys(bags))
    if not unique:
        raise BadUsage(f'{", ".join(names)}: no bag found; give a manifest, bags, or folders '
                       'with bags')
    return unique


def _pattern(text: str) -> re.Pattern[str]:
    try:
        pattern = re.compile(text)
    except re.error as error:
        raise BadUsage(f'--vehicle-from {text}: {error}; {PATTERN_REMEDY}') from None
    if not pattern.groups:
        raise BadUsage(f'--vehicle-from {text}: it has no group; {PATTERN_REMEDY}')
    return pattern


def _bag_of_path(bag: str, pattern: re.Pattern[str] | None) -> FleetBag:
    if pattern is None:
        return FleetBag(PurePosixPath(bag).parent.name, bag)
    match = pattern.search(bag)
    if match is None:
        raise BadUsage(f'--vehicle-from {pattern.pattern}: it does not match the path {bag}; '
                       'change the pattern, or give a manifest')
    groups = match.groupdict()
    return FleetBag(groups.get('vehicle') or match[1] or '', bag, groups.get('model') or '',
                    _odometer_km(groups.get('odometer_km'), bag))


def _odometer_km(value: str | None, origin: str) -> float | None:
    """Return a reading in km, None if it is missing."""
    if not value:
        return None
    try:
        return float(value)
    except ValueError:
        raise BadUsage(f'{origin}: odometer_km {value!r} is not a number') from None


def _read_manifest(name: str) -> list[FleetBag]:
    """Return the rows of a manifest; its paths are relative to its folder."""
    import pyarrow as pa
    from pyarrow import csv, parquet
    fs, path = file_system(name)
    try:
        with fs.open(path, 'rb') as file:
            if name.endswith('.csv'):
                as_text = csv.ConvertOptions(column_types=dict.fromkeys(COLUMNS, pa.string()),
                                             strings_can_be_null=True)
                table = csv.read_csv(file, csv.ReadOptions(use_threads=False),
                                     convert_options=as_text)
            else:
                table = parquet.ParquetFile(file).read(use_threads=False)
    except (OSError, pa.ArrowException) as error:
        raise BadUsage(f'{name}: cannot be read as a manifest ({error_text(error)})') from None
    missing = {'vehicle', 'bag'} - set(table.column_names)
    if missing or not table.num_rows:
        fault = f'no column {" and ".join(sorted(missing))}' if missing else 'it has no bag'
        raise BadUsage(f'{name}: {fault}; '
                       f'required columns: vehicle, bag; optional: {", ".join(COLUMNS[2:])}')
    root = name.removesuffix(PurePosixPath(name).name)
    return [bag_of_row(row, root, f'{name}, row {number}')
            for number, row in enumerate(table.to_pylist(), 2)]


def bag_of_row(row: Mapping[str, Any], root: str, origin: str) -> FleetBag:
    """
    Return the bag in a row of a manifest or a DataFrame, whose empty cells are None, '' or NaN.

    root : folder of relative paths, ends with / or is empty.   origin : of the row, for BadUsage.
    """
    cells = {column: str(value) for column in COLUMNS
             if (value := row.get(column)) is not None and value == value}
    if not (cells.get('vehicle') and cells.get('bag')):
        raise BadUsage(f'{origin}: vehicle or bag is empty')
    bag, config = (path if not path or '://' in path or path.startswith('/') else root + path
                   for path in (cells['bag'], cells.get('config', '')))
    return FleetBag(cells['vehicle'], bag, cells.get('model', ''),
                    _odometer_km(cells.get('odometer_km'), origin), config,
                    tuple(cells.get('legs', '').split()))


def file_system(url: str) -> tuple[Any, str]:
    """Return the fsspec file system of a path or URL, and the path in it."""
    from fsspec.core import url_to_fs
    try:
        fs, path = url_to_fs(url)
        return fs, path
    except (ValueError, ImportError, OSError) as error:      # no such protocol, or its package
        raise BadUsage(f'{url}: {error_text(error)}') from None


def _bags_in(name: str) -> list[str]:
    """Return the bags at a path: itself, the matches of a glob, or all in a folder."""
    fs, path = file_system(name)
    try:
        paths = fs.glob(path) if any(character in path for character in '*?[') else [path]
        bags = [bag for match in sorted(paths) for bag in _bags_in_folder(fs, match)]
        return [str(fs.unstrip_protocol(bag)) for bag in bags] if '://' in name else bags
    except OSError as error:
        raise BadUsage(f'{name}: cannot be read ({error_text(error)})') from None


def _bags_in_folder(fs: Any, path: str) -> list[str]:
    """Return all bags in a folder of a file system, or the path itself if it is a file."""
    if not fs.isdir(path):
        if not fs.exists(path):
            raise BadUsage(f'{path}: no such file or folder')
        return [path]
    files = fs.find(path)
    folders = {str(PurePosixPath(f).parent) for f in files if PurePosixPath(f).name == METADATA}
    single_files = [f for f in files
                    if f.endswith(ENDINGS) and str(PurePosixPath(f).parent) not in folders]
    return sorted([*folders, *single_files])


def is_local(url: str) -> bool:
    """Return True if a path or URL is on this machine; no server is contacted."""
    from fsspec.utils import get_protocol
    return get_protocol(url) in ('file', 'local')


def bag_fingerprint(url: str, settings: str) -> str:
    """Return a hash of path, size and date of a bag, and of settings, for seen/; raises BadBag."""
    try:
        fs, path = file_system(url)
        files = fs.find(path, detail=True) if fs.isdir(path) else {path: fs.info(path)}
        if not files:
            raise FileNotFoundError(f'{url}: not found')
    except Exception as error:     # noqa: BLE001 each kind of server has other errors
        raise BadBag(f'{url}: {error_text(error) or type(error).__name__}') from None
    dates = ('mtime', 'ETag', 'etag', 'LastModified', 'last_modified', 'updated', 'modify', 'CRC')
    return key_of('seen', settings, url, sorted(
        [name, info.get('size'), *(str(info[date]) for date in dates if date in info)]
        for name, info in files.items()))


def _check_disk_space(url: str, fs: Any, path: str, folder: str) -> None:
    """Raise BadBag if a copy would need more than half of the free disk space."""
    files = fs.find(path, detail=True) if fs.isdir(path) else {path: fs.info(path)}
    size = sum(int(info.get('size') or 0) for info in files.values())
    free = shutil.disk_usage(folder).free
    if size > free // 2:
        raise BadBag(f'{url}: its copy takes {size / 1e9:.1f} GB of {free / 1e9:.1f} GB free in '
                     f'{Path(folder).parent}; free disk space, or give workers another '
                     '--local-directory')


@contextmanager
def local_copy(url: str, scratch: str | None) -> Iterator[Path]:
    """Yield the path of a local bag, or of a temporary copy in the folder ``scratch``."""
    fs, path = file_system(url)
    if is_local(url):
        yield Path(path)
        return
    with tempfile.TemporaryDirectory(prefix='odocal_', dir=scratch) as folder:
        name = PurePosixPath(path).name
        copy = Path(folder) / (name if name not in ('', '.', '..') else 'bag')
        try:
            _check_disk_space(url, fs, path, folder)
            fs.get(path, str(copy), recursive=fs.isdir(path))
        except BadBag:
            raise
        except Exception as error:     # noqa: BLE001 each kind of server has other errors
            raise BadBag(f'{url}: {error_text(error) or type(error).__name__}') from None
        yield copy
