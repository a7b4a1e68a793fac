# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The data set of a fleet: one small Parquet file per bag, written atomically.

rows/ab/<key>.parquet: the key is a hash of the bag's content, the settings that affect its legs,
the software version and its stored types; for a failed bag, of its path instead of its content.
seen/ab/<fingerprint> contains the key of a row; the fingerprint is a hash of path, size and date
of the bag, so that known bags are not read again. ab are the first letters of the hash.
"""

from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, fields, is_dataclass
import hashlib
import json
import os
from pathlib import Path
import re
from typing import Any

import numpy as np

from odocal_ros import __version__
from odocal_ros.calib import result
from odocal_ros.calib.marginal_information import MarginalInformation
from odocal_ros.errors import BadData
from odocal_ros.reasons import Code, Reason
from odocal_ros.safe_io.atomic_files import locked, whole_file, write_text
from odocal_ros.safe_io.text_formats import error_text
from odocal_ros.settings.config import Config, flat, with_settings

DONE, FAILED = 'done', 'failed'
KEY, MAGIC = re.compile('[0-9a-f]{40}'), b'PAR1'
# groups of settings that do not affect the legs of a bag
NON_LEG_GROUPS = ('accept', 'output', 'journal', 'publish', 'frames', 'diagnostic_updater')


@dataclass(frozen=True, kw_only=True)
class Row:
    """Data of one bag."""

    key: str
    bag: str                    # path or URL
    vehicle: str
    model: str = ''
    odometer_km: float | None = None
    status: str = DONE
    reason: str = ''            # of a failure
    seen: str = ''              # fingerprint of the bag: file in ``seen``
    sha256: str = ''
    software: str = __version__
    settings: str = '{}'        # JSON, those that are not the default
    topics: str = '{}'          # JSON, slot -> topic
    bytes: int = 0              # size of the bag
    seconds: float = 0.0        # computing time
    driven_s: float = 0.0       # duration of its legs
    start_ns: int = 0           # of its first leg
    legs: str = '[]'            # from ``text_of_legs``

    def config(self) -> Config:
        """Return all settings of the bag."""
        return with_settings(Config(), json.loads(self.settings))

    def leg_results(self) -> list[result.LegResult]:
        """Return the legs of the bag; raise BadData if another version wrote them."""
        try:
            return list(json.loads(self.legs, object_hook=_from_json))
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise BadData(f'{self.bag}: this version cannot read the stored legs '
                          f'({type(error).__name__}: {error_text(error)}); remove the file '
                          f'rows/{self.key[:2]}/{self.key}.parquet in the output folder and '
                          'repeat the command') from None


def key_of(*parts: Any) -> str:
    """Return a hash of the software version, of what a row can hold, and of the parts."""
    # a version under development may remove a reason code or a field of a result
    types = {name: [field.name for field in fields(kind)] for name, kind in STORED_TYPES.items()}
    return hashlib.sha256(json.dumps(
        [__version__, types, list(Code.__members__), *parts]).encode()).hexdigest()[:40]


def changed_settings(config: Config) -> dict[str, Any]:
    """Return the settings that are not the default."""
    default = flat(Config())
    return {name: value for name, value in flat(config).items()
            if repr(value) != repr(default[name])}


def settings_key(config: Config, *others: dict[Any, Any] | tuple[Any, ...]) -> str:
    """Return a hash of the settings that affect the legs of a bag, and of other arguments."""
    return key_of([[name, repr(value)] for name, value in flat(config).items()
                   if name.partition('.')[0] not in NON_LEG_GROUPS], *others)


class RowStore:
    """The rows in an output folder."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)

    def path(self, key: str) -> Path:
        return self.folder / 'rows' / key[:2] / f'{key}.parquet'

    def put(self, row: Row) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq
        path = self.path(row.key)
        path.parent.mkdir(parents=True, exist_ok=True)
        with locked(path.parent), whole_file(path) as file:      # against another fleet command
            pq.write_table(pa.Table.from_pylist([asdict(row)], schema=row_schema()),
                           pa.PythonFile(file, mode='w'), compression='zstd')

    def get(self, key: str) -> Row | None:
        """Return the row of a key, None without one or if the file is not a row."""
        try:
            return next(read_rows([self.path(key)]), None)
        except (BadData, FileNotFoundError):
            return None

    def drop(self, key: str) -> None:
        """Remove the row of a key, if there is one."""
        self.path(key).unlink(missing_ok=True)

    def put_key(self, fingerprint: str, key: str) -> None:
        """Store the key of a bag's row under the fingerprint of the bag."""
        path = self._key_file(fingerprint)
        path.parent.mkdir(parents=True, exist_ok=True)
        with locked(path.parent):
            write_text(path, key)

    def find_key(self, fingerprint: str) -> str | None:
        """Return the key of the existing row of a bag, None without one."""
        try:
            key = self._key_file(fingerprint).read_text()
            exists = KEY.fullmatch(key) and _is_complete(self.path(key))
        except (OSError, UnicodeDecodeError):
            return None
        return key if exists else None

    def _key_file(self, fingerprint: str) -> Path:
        return self.folder / 'seen' / fingerprint[:2] / fingerprint


def row_schema() -> Any:
    """Return the columns of the data set."""
    import pyarrow as pa
    types: dict[Any, Any] = {str: pa.string(), int: pa.int64()}      # others are numbers or None
    return pa.schema([(field.name, types.get(field.type, pa.float64())) for field in fields(Row)])


def _is_complete(path: Path) -> bool:
    """Return True if a file starts and ends like Parquet; a truncated one does not."""
    with open(path, 'rb') as file:
        head = file.read(len(MAGIC))
        file.seek(-len(MAGIC), os.SEEK_END)
        return head == file.read() == MAGIC


def read_rows(paths: Iterable[Path | str]) -> Iterator[Row]:
    """Yield the rows of files in order; raise BadData if a file is not a fleet row."""
    import pyarrow as pa
    import pyarrow.parquet as pq
    for path in paths:
        with open(path, 'rb') as file:
            try:
                # threads of pyarrow abort the process if they still run at its end
                table = pq.ParquetFile(file).read(use_threads=False)
                rows = [Row(**entry) for entry in table.cast(row_schema()).to_pylist()]
            except (pa.ArrowException, OSError, TypeError, ValueError) as error:
                raise BadData(f'{path} is not a fleet row ({error_text(error)}); remove it and '
                              'repeat the command') from None
        yield from rows


STORED_TYPES = {kind.__name__: kind for kind in (
    MarginalInformation, result.Estimate, result.LegResult, result.MethodResult,
    result.PerDistance, Reason, result.Source, result.TrackCheck)}
TYPE_KEY = '~'      # the key of an object's type


def text_of_legs(legs: list[result.LegResult]) -> str:
    """Return legs as JSON, without the rows that only a report draws."""
    return json.dumps([_to_json(leg.without_plot_data()) for leg in legs], separators=(',', ':'))


def _to_json(value: Any) -> Any:
    """Return a value in JSON types; other types are objects with their type at TYPE_KEY."""
    if is_dataclass(value):
        return {TYPE_KEY: type(value).__name__,
                **{field.name: _to_json(getattr(value, field.name)) for field in fields(value)}}
    if isinstance(value, Code):
        return {TYPE_KEY: 'Code', 'of': value.name}
    if isinstance(value, np.ndarray):
        return {TYPE_KEY: 'array', 'of': value.ravel().tolist(), 'shape': value.shape}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, tuple):
        return {TYPE_KEY: 'tuple', 'of': [_to_json(item) for item in value]}
    if isinstance(value, dict):
        if all(isinstance(key, str) and key != TYPE_KEY for key in value):
            return {key: _to_json(item) for key, item in value.items()}
        return {TYPE_KEY: 'dict', 'of': [[_to_json(key), _to_json(item)]
                                         for key, item in value.items()]}
    return [_to_json(item) for item in value] if isinstance(value, list) else value


def _from_json(stored: dict[str, Any]) -> Any:
    """Return the value of an object from ``_to_json``."""
    kind = stored.get(TYPE_KEY)
    if kind is None:
        return stored
    if kind == 'array':
        return np.array(stored['of']).reshape(stored['shape'])
    if kind in ('tuple', 'dict'):
        return {'tuple': tuple, 'dict': dict}[kind](stored['of'])
    if kind == 'Code':
        return Code[stored['of']]
    return STORED_TYPES[kind](**{name: item for name, item in stored.items() if name != TYPE_KEY})
