# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Rows of a bag by slot and column, and the offsets of its chunks."""

from dataclasses import fields

from odocal_ros.bagio.mcap_records import CHUNK
from odocal_ros.bagio.read import open_bag
from odocal_ros.data.leg import LegRecorder
from odocal_ros.messages.decode import make_reader
from odocal_ros.settings.config import Config

SLOTS = {'/imu/data': 'imu', '/odometer': 'odometer', '/fix': 'fix'}


def contents(bag):
    """Return all rows of the topics, by slot and field."""
    recorder = LegRecorder()
    slots = {topic: slot for topic, slot in SLOTS.items() if topic in bag.topics}
    shares = []
    bag.read({topic: make_reader(slot, bag.topics[topic].msgtype, Config())
              for topic, slot in slots.items()}, recorder.feed, shares.append)
    assert shares == sorted(shares)
    assert shares[-1] <= 1
    return {(slot, f.name): getattr(recorder.rows(slot), f.name)
            for slot in slots.values() for f in fields(recorder.rows(slot))}


def read(path):
    with open_bag(path) as bag:
        return contents(bag), bag.notes


def same(found, expected):
    return found.keys() == expected.keys() and all(
        found[k].tobytes() == expected[k].tobytes() for k in expected)


def file_of(path):
    return path if path.is_file() else next(f for f in path.iterdir() if f.suffix != '.yaml')


def chunks_of(data):
    """Return the positions and sizes of the chunk records of an mcap file."""
    at, found = 8, []
    while data[at] != 0x02:
        size = int.from_bytes(data[at + 1:at + 9], 'little')
        if data[at] == CHUNK:
            found.append((at, size + 9))
        at += 9 + size
    return found
