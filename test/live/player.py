# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A small rclpy player: publishes serialised messages by their stamps, N times real time."""

import contextlib
from dataclasses import dataclass
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


def straight(**more):
    """Simulate a straight drive, all stamped: 60 s of rest, 60 s of driving, 60 s of rest."""
    return simulate(SimOptions(**{
        'scenario': 'straight', 'duration': 180.0, 'imu_rate': 50.0, 'odometer_rate': 25.0,
        'odometer': 'speed', 'fix_noise': 'rtk', 'imu_grade': 'tactical'} | more))


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


class Player:
    """Publishes; ``play`` returns when the last message asked for is out."""

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
        """Return a player to whose topics somebody has subscribed."""
        player = cls(client.node, types, names)
        wait_for(player.matched, 'subscriptions of the node')
        return player

    def matched(self) -> bool:
        return all(p.get_subscription_count() for p in self.publishers.values())

    @contextlib.contextmanager
    def playing(self, messages: list[Sent], speed: float):
        """Publish in a thread for as long as the block lasts."""
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


@contextlib.contextmanager
def playing_to(types: dict[str, str], *args: str, names: dict[str, str] | None = None, **more):
    """
    Yield a node with these arguments, a client and a player that it listens to; all end.

    names : slot -> topic where it is remapped.
    """
    remaps = [word for slot, name in (names or {}).items()
              for word in ('-r', f'{TOPICS[slot]}:={name}')]
    node, client = NodeProcess(*args, *remaps, **more), Client()
    try:
        yield node, client, Player.connected(client, types, names)
    finally:
        node.end()
        client.close()


def with_clock(client, player: Player):
    """Return a function that publishes messages, each with its time on /clock."""
    from rosgraph_msgs.msg import Clock
    clock = client.node.create_publisher(Clock, '/clock', 10)
    wait_for(lambda: player.matched() and clock.get_subscription_count(), 'subscriptions')

    def play(messages: list[Sent], pause_s: float = 0.002) -> None:
        for one in messages:
            message = Clock()
            message.clock.sec, message.clock.nanosec = divmod(one.stamp_ns, 10**9)
            clock.publish(message)
            player.publishers[one.slot].publish(one.raw)
            time.sleep(pause_s)
    return play


def part(messages: list[Sent], first_s: float, last_s: float) -> list[Sent]:
    """Return the messages between two times, seconds from the first message."""
    times = (np.array([one.stamp_ns for one in messages]) - messages[0].stamp_ns) * 1e-9
    return [one for one, t in zip(messages, times, strict=True) if first_s <= t < last_s]


def recording(client, driven, first_s: float, start_s: float, speed: float) -> Player:
    """Play messages between two times of a drive, start a leg, and return the player."""
    player = Player.connected(client, driven[0])
    player.play(part(driven[1], first_s, start_s), speed)
    client.until(state='idle')
    assert client.start().success
    return player


def ended(client, player: Player, rows: list[Sent], speed: float):
    """Stop a leg, with these rows after the mark; return the answer with the result."""
    asked = client.ask('stop_leg')
    client.until(state='computing')
    player.play(rows, speed)
    return client.result(asked)


def stopped(client, player: Player, rows: list[Sent], speed: float) -> SimpleNamespace:
    """Stop a leg, with these rows after the mark; return answer, status, journal and result."""
    answer = ended(client, player, rows, speed)
    status = wait_for(lambda: client.status['saved'] and client.status, 'saved files')
    journal = Path(status['journal'])
    wait_for((journal / 'metadata.yaml').exists, 'the joined journal')
    live = json.loads((Path(status['saved']) / 'calibration.json').read_text())
    return SimpleNamespace(stop=answer, status=status, journal=journal, live=live)


def leg_of(drive, driven, settings: dict, rest_s: float = 10.0, leg_s: float = 150.0,
           speed: float = 30.0, names: dict[str, str] | None = None) -> SimpleNamespace:
    """
    Drive one leg from the start mark of a drive; return what ``stopped`` does, and the node.

    driven : as of ``messages_of``.   rest_s, leg_s : of the drive, before the mark and after it.
    """
    types, sent = driven
    start_s = (drive.leg().start_ns - sent[0].stamp_ns) * 1e-9
    with playing_to(types, *given(settings), names=names) as (node, client, player):
        player.play(part(sent, start_s - rest_s, start_s), speed)
        client.start()
        player.play(part(sent, start_s, start_s + leg_s), speed)
        seen = stopped(client, player, part(sent, start_s + leg_s, start_s + leg_s + 3), speed)
        seen.node = node
        return seen


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
