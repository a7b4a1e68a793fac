# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The files of a bag, found from the path that a user names, and decompressed if needed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
import re
import shutil
import sqlite3
from typing import Any

from odocal_ros.bagio.bag_file import is_valid_time
from odocal_ros.bagio.segments import JOURNAL_FILE, without_duplicates
from odocal_ros.errors import BadBag
from odocal_ros.reasons import Code, Reason
from odocal_ros.safe_io import limits
from odocal_ros.safe_io.text_formats import safe_loader

MAGIC = {b'\x89MCAP0\r\n': '.mcap', b'SQLite format 3\0': '.db3', b'#ROSBAG V': '.bag',
         b'\x28\xb5\x2f\xfd': '.zstd'}
# judgement: bytes read at a time. A frame may be short, and the bytes after it are copied
READ_BYTES = 2**13
ENDINGS = ('.mcap', '.db3', '.bag', '.mcap.zstd', '.db3.zstd')


@dataclass(frozen=True)
class Span:
    """End time and number of messages of a bag or of one of its files, from metadata.yaml."""

    end_ns: int
    count: int


@dataclass(frozen=True)
class BagMetadata:
    """Content of metadata.yaml on a bag."""

    file_names: tuple[str, ...] = ()
    bag_span: Span | None = None
    file_spans: Mapping[str, Span] = field(default_factory=dict)      # by name of the file
    foreign_formats: str = ''      # serialization formats, if none is cdr
    fault: str = ''                # why the file is not used


@dataclass(frozen=True)
class Source:
    """The files of a bag, in the order of recording, and the content of metadata.yaml."""

    name: str
    files: tuple[Path, ...]
    notes: tuple[Reason | str, ...] = ()
    metadata: BagMetadata = BagMetadata()


def find_source(path: Path) -> Source:
    """Return the source of a folder, its metadata.yaml, or a file of a bag; raise BadBag."""
    path = Path(path)
    if not path.exists():
        raise BadBag(f'{path}: no such file or folder')
    if path.name == 'metadata.yaml':
        path = path.parent
    if path.is_dir():
        return _source_of_folder(path)
    metadata_path = path.parent / 'metadata.yaml'
    metadata = _read_metadata(metadata_path) if metadata_path.exists() else BagMetadata()
    if path.name not in metadata.file_names:
        return Source(_stem(path), (path,))
    span = metadata.file_spans.get(path.name) or (
        metadata.bag_span if metadata.file_names == (path.name,) else None)
    return Source(_stem(path), (path,), metadata=replace(metadata, bag_span=span, file_spans={}))


def _source_of_folder(path: Path) -> Source:
    """Return the source of a folder: files of metadata.yaml that exist, or all files of bags."""
    metadata_path = path / 'metadata.yaml'
    metadata = _read_metadata(metadata_path) if metadata_path.exists() else None
    listed = metadata.file_names if metadata else ()
    notes: list[Reason | str] = [metadata.fault] if metadata and metadata.fault else []
    files = _without_links([path / file for file in listed if limits.is_file(path / file)])
    missing = [file for file in listed if not limits.is_file(path / file)]
    if missing and files:
        missing_text = ', '.join(missing[:10]) + ' ...' * (len(missing) > 10)
        notes.append(Reason(
            Code.BAG_TRUNCATED, f'{path.resolve().name}: {len(missing)} of {len(listed)} files '
            f'named in metadata.yaml are missing ({missing_text}); the others are read',
            'Copy the missing files into the folder.'))
    if not files:
        files = _without_links(sorted((f for f in path.iterdir()
                                       if f.name.endswith(ENDINGS) and limits.is_file(f)),
                                      key=_number_key))
        if (path / JOURNAL_FILE).exists():
            files = without_duplicates(files)
        if not files:
            raise BadBag(f'{path}: holds no .mcap, .db3 or .bag file{_hint_on_subfolders(path)}')
        fault = 'names no existing file' if listed else 'is missing'
        if metadata is None or listed:
            notes.append(f'{path}: metadata.yaml {fault}; read {len(files)} file'
                         f'{"s" * (len(files) > 1)} in name order')
    return Source(path.resolve().name, tuple(files), tuple(notes), metadata or BagMetadata())


def _without_links(files: list[Path]) -> list[Path]:
    """Return the files without links to an earlier one, so that each is read once."""
    by_inode: dict[tuple[int, int], Path] = {}
    for file in files:
        status = file.stat()
        by_inode.setdefault((status.st_dev, status.st_ino), file)
    return list(by_inode.values())


def _hint_on_subfolders(path: Path) -> str:
    """Return a hint with the bags one folder below, or an empty text."""
    bags = [folder for folder in sorted(path.iterdir()) if folder.is_dir()
            and any(file.name.endswith(ENDINGS) for file in folder.iterdir())]
    one_drive = ' If they are one drive, put their files into one folder' * (len(bags) > 1)
    return f'; did you mean {" or ".join(map(str, bags[:3]))}?{one_drive}' if bags else ''


def _number_key(path: Path) -> list[tuple[int, str]]:
    """Return a sort key that places bag_2 before bag_10."""
    return [(int(part), '') if part.isdigit() else (0, part)
            for part in re.split(r'(\d+)', path.name)]


def _stem(path: Path) -> str:
    return re.sub(r'(\.mcap|\.db3|\.bag)?(\.zstd)?$', '', path.name) or path.name


def _read_metadata(path: Path) -> BagMetadata:
    """Return the content of a metadata.yaml; with ``fault`` if it is invalid."""
    import yaml
    if not limits.is_file(path):
        return BagMetadata(fault=f'{path} is not a regular file; it is ignored')
    try:
        return _parse_metadata(yaml.load(limits.read_text(path), Loader=safe_loader(aliases=True)))
    except (OSError, MemoryError):
        raise
    except limits.LimitReached as error:
        return BagMetadata(fault=f'{error}; it is ignored')
    except Exception as error:      # any error: types, numbers, nesting, encoding
        cause = ' '.join(str(error).split())[:100] if isinstance(error, yaml.YAMLError) else (
            'not the structure that rosbag2 writes')
        return BagMetadata(fault=f'{path} cannot be parsed ({cause}); it is ignored')


def _parse_metadata(content: dict[str, dict[str, Any]]) -> BagMetadata:
    metadata = content['rosbag2_bagfile_information']
    spans = ((Path(file['path']).name, _span(file)) for file in metadata.get('files') or ())
    formats = {topic['topic_metadata'].get('serialization_format', 'cdr')
               for topic in metadata.get('topics_with_message_count') or ()}
    if not all(isinstance(name, str) for name in formats):
        raise ValueError('a serialization format that is not text')
    paths = [Path(path).name for path in metadata.get('relative_file_paths') or ()]
    return BagMetadata(
        tuple(dict.fromkeys(paths)),      # a file named twice is read once
        _span(metadata), {name: span for name, span in spans if span},
        '' if 'cdr' in formats else ', '.join(sorted(formats)))


def _span(metadata: dict[str, Any]) -> Span | None:
    if not metadata.get('message_count') or 'starting_time' not in metadata:
        return None
    end_ns = (int(metadata['starting_time']['nanoseconds_since_epoch'])
              + int(metadata['duration']['nanoseconds']))
    count = int(metadata['message_count'])
    if not (is_valid_time(end_ns) and 0 <= count < 2**62):    # fits int64
        raise ValueError('invalid times or counts')
    return Span(end_ns, count)


def unpack(path: Path, folder: Path, bag_bytes: int) -> tuple[Path, str]:
    """
    Return a plain file with a bag's content, and its kind ('.mcap', '.db3', '.bag').

    Compressed files, and databases with changes in a separate -wal file, are unpacked into
    ``folder``; the user's files are not changed. ``bag_bytes`` is the size of the whole bag.
    """
    kind = kind_of(path)
    if kind == '.zstd':
        path = _decompressed(path, folder, limits.Allowance(path, bag_bytes))
        kind = kind_of(path)
    wal = path.with_name(path.name + '-wal')
    if kind == '.db3' and limits.is_file(wal) and wal.stat().st_size:
        path = _with_wal(path, wal, folder)
    if path.suffix != kind:
        link = folder / f'{path.name}{kind}'
        link.symlink_to(path.resolve())
        path = link
    return path, kind


def kind_of(path: Path) -> str:
    """Return the format of a file from its first bytes, or raise BadBag."""
    if path.exists() and not limits.is_file(path):
        raise BadBag(f'{path} is not a regular file; give a bag file')
    with path.open('rb') as file:
        head = file.read(16)
    for magic, kind in MAGIC.items():
        if head.startswith(magic):
            return kind
    content = 'a text file' if head and all(9 <= byte < 127 for byte in head) else (
        f'a file that starts with the bytes {head[:4].hex(" ")}' if head else 'an empty file')
    raise BadBag(f'{path.name}: {content}, which is not a bag; give a rosbag2 folder, or a '
                 '.mcap, .db3 or .bag file')


def _decompressed(path: Path, folder: Path, allowance: limits.Allowance) -> Path:
    """Return the decompressed file, as far as it is complete and undamaged."""
    zstd = limits.zstd_module()
    target = folder / path.name.removesuffix('.zstd')
    with path.open('rb') as packed, target.open('wb') as out:
        frames = 1
        frame, data = zstd.ZstdDecompressor(), b''   # also decompresses a truncated file
        # until neither data that were read, nor the frame, nor the file have more
        while data or not (frame.needs_input or frame.eof) or (data := packed.read(READ_BYTES)):
            if frame.eof:
                frames += 1
                allowance.check_frames(frames, packed.tell())
                frame = zstd.ZstdDecompressor()
            try:
                piece = frame.decompress(data, 2**20)
            except zstd.ZstdError:     # damaged: the output is used like a truncated file
                return target
            allowance.add(len(piece))
            out.write(piece)
            data = frame.unused_data if frame.eof else b''
    return target


def _with_wal(path: Path, wal: Path, folder: Path) -> Path:
    """Return a copy of a database with the changes in its -wal file."""
    target = folder / path.name
    shutil.copyfile(path, target)
    shutil.copyfile(wal, target.with_name(target.name + '-wal'))
    try:
        db = sqlite3.connect(target)
        db.execute('PRAGMA wal_checkpoint(TRUNCATE)').fetchall()
        db.close()
    except sqlite3.DatabaseError:
        shutil.copyfile(path, target)     # a -wal of another file: not used
    return target


def file_names(paths: Sequence[Path]) -> str:
    """Return the names of files as text."""
    return ', '.join(path.name for path in paths)
