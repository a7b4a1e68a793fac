# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
How soon ~/stop_leg answers after a long leg, and when the final result is there.

    python benchmarks/long_leg_answer.py [--seconds 3600] [--imu 200] [--seed 1]

The messages of a simulated town drive (counts of 50 Hz as speed, fixes of 1 Hz) go to a real node
over DDS, as fast as it takes them. Printed: the time from the call of ~/stop_leg to its answer,
beside the goal, and to the final result on ~/status; the CPU of the node meanwhile; both texts.
"""

import tempfile
import time

from harness import parsed
import numpy as np

BEFORE_S, AFTER_S = 15.0, 3.0      # s, sent before the start mark and after the stop mark
BLOCK_S = 10.0                     # s of the drive sent at once
MAX_AHEAD_S = 20.0                # s of the drive that the node has not taken yet, each topic
SHOWN = {'fix': 'gnss'}            # names of inputs in the diagnostics
GOAL_S, LONGEST_S = 5.0, 3600.0    # s, of the answer; of the final result, given up then


class Sender:
    """Publishes a drive as fast as the node takes it, some seconds at a time."""

    def __init__(self, client, drive) -> None:
        from player import Player

        from odocal_ros.bagio import encode
        self._topics = {'imu': encode.imu('imu/data', drive.imu),
                        'odometer': encode.twist('odometer', drive.odometer),
                        'fix': encode.fix('fix', drive.fix)}
        self._player = Player(client.node, {slot: t.msgtype for slot, t in self._topics.items()})
        self._client = client
        self._sent = dict.fromkeys(self._topics, 0)
        self._seconds = int(drive.imu.stamp_ns[-1] - drive.imu.stamp_ns[0]) * 1e-9
        self._first_ns = int(drive.imu.stamp_ns[0])

    def received(self) -> bool:
        """Return True if the node subscribes to every topic."""
        return self._player.matched()

    def send(self, first_s: float, last_s: float) -> None:
        """Publish what lies between two times of the drive."""
        for begin in np.arange(first_s, last_s, BLOCK_S):
            self._block(begin, min(begin + BLOCK_S, last_s))

    def _block(self, first_s: float, last_s: float) -> None:
        from bench import wait_for
        ends_ns = self._first_ns + np.array([first_s * 1e9, last_s * 1e9]).astype(np.int64)
        rows = []
        for slot, topic in self._topics.items():
            some = slice(*np.searchsorted(topic.time_ns, ends_ns))
            rows += [(int(t), slot, row.tobytes()) for t, row in zip(
                topic.time_ns[some], topic.pack(some), strict=True)]
        for _, slot, raw in sorted(rows, key=lambda row: row[0]):
            self._player.publishers[slot].publish(raw)
            self._sent[slot] += 1
        wait_for(lambda: max(map(self._ahead_s, self._sent)) < MAX_AHEAD_S, 'what was sent',
                 LONGEST_S)

    def _ahead_s(self, slot: str) -> float:
        """Return the time, s, of what was sent on a topic and not taken."""
        seen = self._client.health.get(f'calibrator: {SHOWN.get(slot, slot)}', {})
        taken = int(seen.get('messages', 0)) + int(seen.get('dropped', 0))
        return (self._sent[slot] - taken) * self._seconds / len(self._topics[slot].time_ns)


def measure(client, node, drive, seconds: float) -> None:
    """Drive the leg, stop it, and print when the answer came, and when the result."""
    from bench import wait_for
    from live_load import cpu_s
    sender = Sender(client, drive)
    wait_for(sender.received, 'subscriptions of the node')
    sender.send(0.0, BEFORE_S)
    client.start()
    sender.send(BEFORE_S, seconds)
    wait_for(lambda: float(client.status['duration_s']) > 0.99 * (seconds - BEFORE_S), 'the leg')
    used, asked = cpu_s(node.process.pid), time.perf_counter()
    stopping = client.ask('stop_leg')
    sender.send(seconds, seconds + AFTER_S)
    wait_for(stopping.done, 'the answer', LONGEST_S)
    answered = time.perf_counter() - asked
    wait_for(lambda: client.status['state'] in ('calibrated', 'rejected', 'failed'), 'the result',
             LONGEST_S)
    done = time.perf_counter() - asked
    print(f'{client.status["duration_s"]} s of a leg: ~/stop_leg answered after {answered:.1f} s, '
          f'goal {GOAL_S:g}{"" if answered <= GOAL_S else "   MISSED"}; final result after '
          f'{done:.1f} s, {cpu_s(node.process.pid) - used:.1f} s of CPU')
    print(f'answer, success {stopping.result().success}: {stopping.result().message}')
    print(f'~/status then: {client.status["message"]}')
    print(f'~/stop_leg then: {client.call("stop_leg").message}')


def main() -> None:
    """Simulate, drive, stop."""
    from bench import Client, NodeProcess

    from odocal_ros.sim.scenarios import SimOptions, simulate
    args = parsed(__doc__, seconds=3600.0, imu=200.0, seed=1)
    drive = simulate(SimOptions(
        scenario='town', duration=args.seconds + AFTER_S, imu_rate=args.imu, odometer_rate=50.0,
        odometer='speed', seed=args.seed))
    with tempfile.TemporaryDirectory(prefix='odocal_answer_') as folder:
        # so fast that a sender who need not wait would lose some
        reliable = [x for name in ('imu/data', 'odometer', 'fix') for x in (
            '-p', f'qos_overrides./{name}.subscription.reliability:=reliable')]
        node = NodeProcess('-p', f'output.directory:={folder}', '-p',
                           'diagnostic_updater.period:=0.1', *reliable)
        client = Client()
        try:
            measure(client, node, drive, args.seconds)
        finally:
            node.end()
            client.close()


if __name__ == '__main__':
    main()
