# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Drives played to a node: serialised messages in order of stamps, N times real time."""

import contextlib
from dataclasses import dataclass, replace
from functools import cached_property
import importlib
import json
from pathlib import Path
import threading
import time
from types import SimpleNamespace

from bench import Client, given, NodeProcess, wait_for
import numpy as np
from rclpy.qos import QoSProfile, ReliabilityPolicy

from odocal_ros.bagio import encode
from odocal_ros.data.inputs import TOPICS
from odocal_ros.sim.scenarios import SimOptions, simulate


@dataclass(frozen=True)
class Sent:
    """One message: when (ns on the sensors' clock), where, what."""

    stamp_ns: int
    slot: str
    raw: bytes


def sent_of(slot: str, topic: encode.Topic) -> list[Sent]:
    """Return the messages of a topic, serialised."""
    packed = topic.pack(slice(0, len(topic.time_ns)))
    return [Sent(int(t), slot, row.tobytes()) for t, row in zip(topic.time_ns, packed,
                                                                strict=True)]


def stamp_of(message) -> int:
    """Return the header stamp of a message, ns."""
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def ends_of(status: dict) -> tuple[int, int]:
    """Return the marks of the leg in a status, ns."""
    return int(status['leg_start_ns']), int(status['leg_stop_ns'])


def within(found: dict, true: float, sigmas: float = 4.0) -> bool:
    """Return True if a value is within 4 sigmas of the truth; 1 in 16 000 is not."""
    return abs(found['value'] - true) < sigmas * found['sigma']


def straight(**more):
    """Simulate a straight drive, all stamped: 60 s of rest, 60 s of driving, 60 s of rest."""
    return simulate(SimOptions(**{
        'scenario': 'straight', 'duration': 180.0, 'imu_rate': 50.0, 'odometer_rate': 25.0,
        'odometer': 'speed', 'fix_noise': 'rtk', 'imu_grade': 'tactical'} | more))


def moved(samples, by_ns: int):
    stamps = samples.stamp_ns + by_ns
    return replace(samples, stamp_ns=stamps, received_ns=stamps)


def messages_of(drive, **others: encode.Topic | None) -> tuple[dict[str, str], list[Sent]]:
    """
    Return slot -> message type and all messages of a drive, in order.

    The odometer is a speed and the reference a fix unless ``others`` has another topic, or None.
    """
    topics = {'imu': encode.imu('imu/data', drive.imu)} | others
    if 'odometer' not in topics:
        topics['odometer'] = encode.twist('odometer', drive.odometer)
    if 'fix' not in topics:
        topics['fix'] = encode.fix('fix', drive.fix)
    topics = {slot: topic for slot, topic in topics.items() if topic is not None}
    sent = [one for slot, topic in topics.items() for one in sent_of(slot, topic)]
    return ({slot: topic.msgtype for slot, topic in topics.items()},
            sorted(sent, key=lambda one: one.stamp_ns))


def light(first_s: float = 60.0, last_s: float = 120.0) -> tuple[dict[str, str], list[Sent]]:
    """Return a part of a drive at slow rates: enough to start a leg, light to play."""
    types, sent = messages_of(simulate(SimOptions(
        duration=180.0, imu_rate=20.0, odometer_rate=10.0, odometer='speed')))
    return types, part(sent, first_s, last_s)


class Player:
    """Publishes; ``play`` returns when the last requested message is sent."""

    def __init__(self, node, types: dict[str, str], names: dict[str, str] | None = None) -> None:
        names = TOPICS | (names or {})
        # what a busy subscriber has not taken yet is kept for it, however long it takes
        qos = QoSProfile(depth=20_000, reliability=ReliabilityPolicy.RELIABLE)
        self.publishers = {}
        self._stop = threading.Event()
        for slot, msgtype in types.items():
            package, folder, name = msgtype.split('/')
            kind = getattr(importlib.import_module(f'{package}.{folder}'), name)
            self.publishers[slot] = node.create_publisher(kind, names[slot], qos)

    @classmethod
    def connected(cls, client: Client, types: dict[str, str], names: dict[str, str] | None = None
              ) -> 'Player':
        """Return a player when its topics have subscribers."""
        player = cls(client.node, types, names)
        wait_for(player.matched, 'subscriptions of the node')
        return player

    def matched(self) -> bool:
        return all(p.get_subscription_count() for p in self.publishers.values())

    @contextlib.contextmanager
    def playing(self, messages: list[Sent], speed: float):
        """Publish in a thread during the block."""
        self._stop.clear()
        thread = threading.Thread(target=self.play, args=(messages, speed), daemon=True)
        thread.start()
        try:
            yield
        finally:
            self._stop.set()
            thread.join()
            self._stop.clear()

    def play(self, messages: list[Sent], speed: float) -> None:
        """Publish messages in the rhythm of their stamps, ``speed`` times real time."""
        if not messages:
            return
        begin, first_ns = time.monotonic(), messages[0].stamp_ns
        for one in messages:
            ahead = (one.stamp_ns - first_ns) * 1e-9 / speed - (time.monotonic() - begin)
            if ahead > 0.001 and self._stop.wait(ahead):
                return
            self.publishers[one.slot].publish(one.raw)


def part(messages: list[Sent], first_s: float, last_s: float) -> list[Sent]:
    """Return the messages between two times, seconds from the first message."""
    times = (np.array([one.stamp_ns for one in messages]) - messages[0].stamp_ns) * 1e-9
    return [one for one, t in zip(messages, times, strict=True) if first_s <= t < last_s]


class Drive:
    """
    A node and a drive (as of ``messages_of``) that is played to it; times are s of the drive.

    speed : times real time.   names : slot -> topic where it is remapped.
    """

    def __init__(self, node: NodeProcess, client: Client, driven, speed: float = 30.0,
                 names: dict[str, str] | None = None) -> None:
        self.types, self.sent = driven
        self.node, self.client, self.speed = node, client, speed
        self.names = names

    @cached_property
    def player(self) -> Player:
        """Return the player when its topics have subscribers."""
        return Player.connected(self.client, self.types, self.names)

    def part(self, first_s: float, last_s: float) -> list[Sent]:
        return part(self.sent, first_s, last_s)

    def play(self, first_s: float, last_s: float, speed: float | None = None) -> None:
        self.player.play(self.part(first_s, last_s), speed or self.speed)

    def playing(self, first_s: float, last_s: float, speed: float | None = None):
        """Play in a thread during the block."""
        return self.player.playing(self.part(first_s, last_s), speed or self.speed)

    def record(self, first_s: float, start_s: float, stop_s: float = 0.0) -> None:
        """Play from one time, start a leg at another, and play on to a third."""
        self.play(first_s, start_s)
        if self.client.status.get('state', 'waiting') == 'waiting':
            self.client.until(state='idle')
        assert self.client.start().success
        self.play(start_s, stop_s)

    def ended(self, stop_s: float, after_s: float = 2.0):
        """Stop a leg and play on for a while; return the answer with the result."""
        call = self.client.ask('stop_leg')
        self.client.until(state='computing')
        self.play(stop_s, stop_s + after_s)
        return self.client.result(call)

    def stopped(self, stop_s: float, after_s: float = 2.0) -> SimpleNamespace:
        """Stop a leg; return the answer, and what ``written`` does."""
        answer = self.ended(stop_s, after_s)
        return SimpleNamespace(stop=answer, **vars(self.written()))

    def written(self) -> SimpleNamespace:
        """Return status, journal and result once both are written, and the node."""
        status = wait_for(lambda: self.client.status['saved'] and self.client.status,
                          'saved files')
        journal = Path(status['journal'])
        wait_for((journal / 'metadata.yaml').exists, 'the joined journal')
        live = json.loads((Path(status['saved']) / 'calibration.json').read_text())
        return SimpleNamespace(status=status, journal=journal, live=live, node=self.node)


@contextlib.contextmanager
def playing_to(driven, settings: dict, speed: float = 30.0, names: dict[str, str] | None = None,
               words: tuple[str, ...] = (), module: str = 'node', **more):
    """
    Yield the Drive of a node with these settings that listens to it; all end.

    words : further ROS arguments.   module : of live/ that holds the node.
    """
    remaps = [word for slot, name in (names or {}).items()
              for word in ('-r', f'{TOPICS[slot]}:={name}')]
    node = NodeProcess(*words, *given(settings), *remaps, module=module, **more)
    client = Client('calibrator' if module == 'node' else module)
    try:
        yield Drive(node, client, driven, speed, names)
    finally:
        node.end()
        client.close()


def with_clock(leg: Drive):
    """Return a function that plays a part of a drive, each message with its time on /clock."""
    from rosgraph_msgs.msg import Clock
    clock = leg.client.node.create_publisher(Clock, '/clock', 10)
    wait_for(lambda: leg.player and clock.get_subscription_count(), 'subscriptions')

    def play(first_s: float, last_s: float, pause_s: float = 0.002) -> None:
        for one in leg.part(first_s, last_s):
            message = Clock()
            message.clock.sec, message.clock.nanosec = divmod(one.stamp_ns, 10**9)
            clock.publish(message)
            leg.player.publishers[one.slot].publish(one.raw)
            time.sleep(pause_s)
    return play


def all_arrived(client: Client, messages: list[Sent]) -> None:
    """Wait until the diagnostics count all messages; none is lost or unreadable."""
    for slot, name in (('imu', 'imu'), ('odometer', 'odometer'), ('fix', 'gnss')):
        count = str(sum(one.slot == slot for one in messages))

        def counted(name=name, count=count):
            health = client.health.get(f'calibrator: {name}', {})
            return health.get('messages') == count and health
        health = wait_for(counted, f'{count} messages of {name}')
        assert (health['dropped'], health['unreadable']) == ('0', '0')


def leg_of(folder: Path, options: dict, topics=lambda drive: {}, settings=lambda drive: {},
           rest_s: float = 10.0, leg_s: float = 150.0, **more) -> SimpleNamespace:
    """
    Simulate a drive and drive one leg from its start mark; return what ``stopped`` does, and it.

    topics, settings : functions of the drive, its other topics as of ``messages_of``.   rest_s,
    leg_s : of the drive, before the mark and after it.   more : as of ``playing_to``.
    """
    drive = simulate(SimOptions(**options))
    driven = messages_of(drive, **topics(drive))
    start_s = (drive.leg().start_ns - driven[1][0].stamp_ns) * 1e-9
    overrides = {'output.directory': folder, 'leg.preroll': 20.0} | settings(drive)
    with playing_to(driven, overrides, **more) as leg:
        leg.record(start_s - rest_s, start_s, start_s + leg_s)
        seen = leg.stopped(start_s + leg_s, 3.0)
    assert seen.stop.success, seen.stop.message
    return SimpleNamespace(drive=drive, **vars(seen))


def by_now(make):
    """
    Return a moment that is still to come, ns on the wall clock, and what ``make`` gives for it.

    What is made ready meanwhile would be late on a busy machine: then for a later one.
    """
    ahead_ns = 10**9
    while True:
        begin_ns = time.time_ns() + ahead_ns
        made = make(begin_ns)
        if time.time_ns() < begin_ns:
            return begin_ns, made
        ahead_ns *= 2
