"""From a path that a user gives to the files of a bag, unpacked where they are compressed."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
import re
import shutil
import sqlite3

from odocal_ros.bagio.numbered import JOURNAL, without_joined
from odocal_ros.errors import BadBag

MAGIC = {b'\x89MCAP0\r\n': '.mcap', b'SQLite format 3\0': '.db3', b'#ROSBAG V': '.bag',
         b'\x28\xb5\x2f\xfd': '.zstd'}
ENDINGS = ('.mcap', '.db3', '.bag', '.mcap.zstd', '.db3.zstd')


@dataclass(frozen=True)
class Span:
    """What metadata.yaml says of a bag or one of its files."""

    end_ns: int
    count: int


@dataclass(frozen=True)
class Source:
    """The files of a bag, in the order they were recorded, and what metadata.yaml says."""

    name: str
    files: tuple[Path, ...]
    notes: tuple[str, ...] = ()
    whole: Span | None = None
    of_file: tuple[tuple[str, Span], ...] = ()
    foreign: str = ''                    # a serialization format that is not cdr


def find(path: Path) -> Source:
    """
    Return the source that a path names: a folder, its metadata.yaml, or a file of a bag.

    Raises
    ------
    BadBag
        Nothing there, or nothing that is a bag.

    """
    path = Path(path)
    if not path.exists():
        raise BadBag(f'{path}: no such file or folder')
    if path.name == 'metadata.yaml':
        path = path.parent
    if path.is_dir():
        return _folder(path)
    beside = path.parent / 'metadata.yaml'
    known = _read_metadata(beside)[0] if beside.exists() else {}
    mine = [item for item in known.get('files') or () if Path(item['path']).name == path.name]
    if not mine and _file_names(known) == [path.name]:
        mine = [known]
    return Source(_stem(path), (path,), whole=_span(mine[0]) if mine else None,
                  foreign=_foreign(known) if path.name in _file_names(known) else '')


def _folder(path: Path) -> Source:
    name = path.resolve().name
    notes: list[str] = []
    known: dict = {}
    if (path / 'metadata.yaml').exists():
        known, trouble = _read_metadata(path / 'metadata.yaml')
        notes += [trouble] * bool(trouble)
    wanted = _file_names(known)
    files = [path / file for file in wanted if (path / file).exists()]
    lost = [file for file in wanted if not (path / file).exists()]
    if lost and files:
        notes.append(f'{path}: {len(lost)} of {len(wanted)} files named in metadata.yaml are '
                     f'missing ({", ".join(lost)}); the others are read')
    if not files:
        files = sorted((f for f in path.iterdir() if f.name.endswith(ENDINGS)), key=_by_number)
        if (path / JOURNAL).exists():
            files = without_joined(files)
        if not files:
            raise BadBag(f'{path}: holds no .mcap, .db3 or .bag file{_hint(path)}')
        what = 'names no file that is here' if known else 'is missing'
        notes.append(f'{path}: metadata.yaml {what}; read {len(files)} file'
                     f'{"s" * (len(files) > 1)} in name order')
    spans = tuple((Path(item['path']).name, _span(item)) for item in known.get('files') or ())
    return Source(name, tuple(files), tuple(notes), _span(known) if known else None,
                  tuple((file, span) for file, span in spans if span), _foreign(known))


def _hint(path: Path) -> str:
    """Name the bags one folder below, which is the usual slip."""
    below = [sub for sub in sorted(path.iterdir()) if sub.is_dir()
             and any(file.name.endswith(ENDINGS) for file in sub.iterdir())]
    return f'; did you mean {" or ".join(map(str, below[:3]))}?' if below else ''


def _by_number(path: Path):
    """Sort bag_2 before bag_10."""
    return [(int(part), '') if part.isdigit() else (0, part)
            for part in re.split(r'(\d+)', path.name)]


def _stem(path: Path) -> str:
    name = path.name
    for ending in ('.zstd', '.mcap', '.db3', '.bag'):
        name = name.removesuffix(ending)
    return name or path.name


def _read_metadata(path: Path) -> tuple[dict, str]:
    """Return the metadata, or {} and what is wrong with it."""
    import yaml
    try:
        known = yaml.safe_load(path.read_text(encoding='utf-8'))['rosbag2_bagfile_information']
        if not isinstance(known, dict):
            raise ValueError('no mapping')
        _span(known), _file_names(known)
        return known, ''
    except (yaml.YAMLError, ValueError, KeyError, TypeError) as error:
        why = ' '.join(str(error).split())[:100]
        return {}, f'{path}: cannot be understood ({why}), so it is not used'


def _file_names(known: dict) -> list[str]:
    return [Path(name).name for name in known.get('relative_file_paths') or ()]


def _span(known: dict) -> Span | None:
    """Return the end and the count that metadata tell, of a bag or one file."""
    if not known.get('message_count') or 'starting_time' not in known:
        return None
    return Span(int(known['starting_time']['nanoseconds_since_epoch'])
                + int(known['duration']['nanoseconds']), int(known['message_count']))


def _foreign(known: dict) -> str:
    """Return a serialization format other than cdr, where all topics have one."""
    topics = known.get('topics_with_message_count') or ()
    formats = {topic['topic_metadata'].get('serialization_format', 'cdr') for topic in topics}
    return '' if 'cdr' in formats or not formats else ', '.join(sorted(formats))


def unpack(path: Path, folder: Path) -> tuple[Path, str]:
    """
    Return a plain file with a bag's content, and its kind ('.mcap', '.db3', '.bag').

    Compressed files, and databases with changes still in a -wal file beside them, are unpacked
    into ``folder``; the user's files stay as they are.
    """
    kind = kind_of(path)
    if kind == '.zstd':
        path = _decompressed(path, folder)
        kind = kind_of(path)
    wal = path.with_name(path.name + '-wal')
    if kind == '.db3' and wal.exists() and wal.stat().st_size:
        path = _with_wal(path, wal, folder)
    if path.suffix != kind:
        link = folder / f'{path.name}{kind}'
        link.symlink_to(path.resolve())
        path = link
    return path, kind


def kind_of(path: Path) -> str:
    """Return what a file is by its first bytes, or raise BadBag."""
    with path.open('rb') as file:
        head = file.read(16)
    for magic, kind in MAGIC.items():
        if head.startswith(magic):
            return kind
    what = 'is an empty file' if not head else 'is no bag'
    raise BadBag(f'{path.name}: {what}; give a folder with metadata.yaml or a .mcap, .db3 or .bag '
                 'file')


def _decompressed(path: Path, folder: Path) -> Path:
    """Decompress as much of a file as is there."""
    zstd = zstd_module()
    target = folder / path.name.removesuffix('.zstd')
    with path.open('rb') as packed, target.open('wb') as out:
        frame = zstd.ZstdDecompressor()    # gives what there is of a file that is cut off
        while data := packed.read(2**18):
            while data:
                if frame.eof:
                    frame = zstd.ZstdDecompressor()
                try:
                    out.write(frame.decompress(data))
                except zstd.ZstdError:     # damaged: what came out is recovered like a cut file
                    return target
                data = frame.unused_data if frame.eof else b''
    return target


def _with_wal(path: Path, wal: Path, folder: Path) -> Path:
    """Return a copy of a database with the changes that its -wal file holds."""
    target = folder / path.name
    shutil.copyfile(path, target)
    shutil.copyfile(wal, target.with_name(target.name + '-wal'))
    try:
        db = sqlite3.connect(target)
        db.execute('PRAGMA wal_checkpoint(TRUNCATE)').fetchall()
        db.close()
    except sqlite3.DatabaseError:
        shutil.copyfile(path, target)     # a -wal of another file: without it, then
    return target


def zstd_module():
    """Return the zstd module that rosbags uses: the standard library's from Python 3.14 on."""
    from importlib import import_module
    try:
        return import_module('compression.zstd')
    except ModuleNotFoundError:
        return import_module('backports.zstd')


def names(paths: Sequence[Path]) -> str:
    """Name some files for people."""
    return ', '.join(path.name for path in paths)
