# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
A long day of the node: hours of simulated time, a leg every quarter of an hour, looked at by leg.

    python benchmarks/soak.py [--hours 24] [--speedup 40] [--legs 100] [--log FILE]

The node runs in simulated time (/clock) and receives out-and-back drives, the same ten again and
again, with stamps that go on; between the drives its sensors are silent. The node ``odometry``
runs beside it on the same topics. After each leg, once its files are written and the vehicle has
rested, are printed: memory, threads and descriptors of the process, memory and descriptors of
``odometry`` and how many poses it published, the latency of a service call in the leg, the time
that the answer of ~/stop_leg took, what is in the output folder, and how far the scale factor is
from the truth. At the end the last quarter of the legs is compared with the second one; the exit
code is 1 if anything grew, or a leg was wrong.
"""

from contextlib import suppress
import csv
from dataclasses import asdict, dataclass, fields
import os
from pathlib import Path
import statistics
import struct
import sys
import tempfile
import time

from harness import parsed

os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

DRIVE_S, START_S, TICK_S, SIGMAS = 260.0, 20.0, 0.2, 5.0
MAX_AHEAD = 50     # messages of a topic that the node may be behind
LONGEST_S = 300.0   # an answer
DRIVES = 10          # of one vehicle, each with noise of its own
PARKED = 20.0       # times as fast does time go by while nothing is sent
GROWTH = {'rss_mib': 0.05, 'threads': 0.0, 'descriptors': 0.0, 'odometry_mib': 0.05,
          'odometry_descriptors': 0.0, 'call_ms': 0.5}      # of the earlier
MIN_GROWN = {'call_ms': 20.0}       # ms: less is not looked at, on a machine with others on it


@dataclass(frozen=True)
class Look:
    """What is seen after a leg."""

    leg: int
    hour: float              # simulated
    rss_mib: float
    threads: int
    descriptors: int
    odometry_mib: float
    odometry_descriptors: int
    poses: int               # so far
    call_ms: float           # median, in the leg
    stop_s: float
    folder_mib: float
    verdict: str
    sigmas: float            # off the truth; nan where nothing was given


class Day:
    """Plays the drive again and again, on one clock."""

    def __init__(self, client, drives, speedup: float, period_s: float) -> None:
        from player import messages_of, Player
        from rosgraph_msgs.msg import Clock
        types, _ = messages_of(drives[0])
        self._drives = [messages_of(drive)[1] for drive in drives]
        self._first_ns = self._drives[0][0].stamp_ns
        self._player, self._speedup = Player(client.node, types), speedup
        self._clock, self._kind = client.node.create_publisher(Clock, '/clock', 10), Clock
        self._round, self._period_s, self._client, self._sent_imu = 0, period_s, client, 0
        self.now_s, self._due = 0.0, time.monotonic()

    def received(self) -> bool:
        """Return True if the node subscribes to the topics and has received the clock."""
        self.tell_time()
        time.sleep(0.5)
        return self._player.matched() and bool(self._clock.get_subscription_count())

    def play(self, first_s: float, last_s: float) -> None:
        """Play a part of the drive of this round."""
        shift_s = self._round * self._period_s
        for one in self._drives[self._round % len(self._drives)]:
            t = (one.stamp_ns - self._first_ns) * 1e-9
            if first_s <= t < last_s:
                self._wait_until(t + shift_s)
                stamp_ns = one.stamp_ns + round(shift_s * 1e9)
                raw = (one.raw[:4] + struct.pack('<iI', *divmod(stamp_ns, 10**9)) + one.raw[12:])
                self._player.publishers[one.slot].publish(raw)
                self._sent_imu += one.slot == 'imu'
                if one.slot == 'imu' and self._sent_imu % MAX_AHEAD == 0:
                    self._let_it_hear(MAX_AHEAD)
        self._let_it_hear(0)

    def _let_it_hear(self, ahead: int) -> None:
        """Wait until the node has not more messages of the IMU before it."""
        from bench import wait_for

        def near():
            seen = self._client.health.get('calibrator: imu', {})
            return int(seen.get('messages', 0)) + int(seen.get('dropped', 0)) >= (
                self._sent_imu - ahead)
        wait_for(near, 'what was sent')

    def rest(self) -> None:
        """Let time go on without sensors until the next round."""
        self._round += 1
        speedup, self._speedup = self._speedup, self._speedup * PARKED
        self._wait_until(self._round * self._period_s)
        self._speedup = speedup

    def _wait_until(self, t: float) -> None:
        """Let simulated time go on; on a machine that does not keep up it goes slower."""
        while self.now_s < t:
            step = min(t, (int(self.now_s / TICK_S + 1e-6) + 1) * TICK_S)
            self._due += (step - self.now_s) / self._speedup
            wait = self._due - time.monotonic()
            if wait > 0.001:
                time.sleep(wait)
            self._due = max(self._due, time.monotonic() - 0.1)     # never makes up for a pause
            self.now_s = step
            self.tell_time()

    def tell_time(self) -> None:
        """Publish the clock."""
        now, message = self._first_ns + round(self.now_s * 1e9), self._kind()
        message.clock.sec, message.clock.nanosec = divmod(now, 10**9)
        self._clock.publish(message)


def size_mib(folder: Path) -> float:
    """Return the size of a folder that the node writes to at the same time."""
    size = 0
    for place, _, names in os.walk(folder):
        for name in names:
            with suppress(FileNotFoundError):
                size += Path(place, name).stat().st_size
    return size / 2**20


def used_by(process) -> tuple[float, int, int]:
    """Return memory, MiB, threads and descriptors of a process."""
    proc = Path(f'/proc/{process.pid}')
    rss = next(line for line in (proc / 'status').read_text().splitlines() if 'VmRSS' in line)
    return (int(rss.split()[1]) / 1024, len(list((proc / 'task').iterdir())),
            len(list((proc / 'fd').iterdir())))


def one_leg(day, client, node, odometry, poses, folder, leg, truth) -> Look:
    """Drive a leg and look at the nodes after it."""
    from bench import wait_for
    day.play(0.0, START_S)
    client.start()
    calls = []
    for begin in range(int(START_S), int(DRIVE_S) - 5, 25):
        day.play(begin, min(begin + 25.0, DRIVE_S - 5))
        asked = time.perf_counter()
        client.call('start_leg')                 # answers 'recording since'
        calls.append((time.perf_counter() - asked) * 1e3)
    saved = client.status['saved']
    asked, begin = client.ask('stop_leg'), time.perf_counter()
    day.play(DRIVE_S - 5, DRIVE_S)
    wait_for(lambda: asked.done() or node.process.poll() is not None,
             'the answer of ~/stop_leg', LONGEST_S)
    if not asked.done():
        sys.exit(f'the node has ended with {node.process.poll()}: {node.lines[-5:]}')
    stop_s = time.perf_counter() - begin
    wait_for(lambda: client.status['state'] != 'computing', 'the result', LONGEST_S)
    wait_for(lambda: client.status['saved'] not in ('', saved), 'its files', LONGEST_S)
    status = client.status
    day.rest()
    value, sigma = (float(status[k]) for k in ('scale_factor', 'scale_factor_sigma'))
    if odometry.process.poll() is not None:
        sys.exit(f'odometry has ended with {odometry.process.poll()}: {odometry.lines[-15:]}')
    beside = used_by(odometry.process)
    return Look(leg, day.now_s / 3600, *used_by(node.process), beside[0], beside[2], len(poses),
                statistics.median(calls), stop_s, size_mib(folder), status['verdict'],
                abs(value - truth) / sigma)


def grown(looks: list[Look]) -> list[str]:
    """Return the growth from the second quarter of the legs to the last, as text."""
    quarter = len(looks) // 4
    found = []
    for name, most in GROWTH.items():
        # some descriptors are open for a moment: what leaks raises the least of them
        usual = min if most == 0.0 else statistics.median
        before, after = (usual(getattr(one, name) for one in part)
                         for part in (looks[quarter:2 * quarter], looks[-quarter:]))
        grew = after > max(before * (1 + most), MIN_GROWN.get(name, 0.0))
        print(f'{name}: {before:.4g} in legs {quarter + 1} to {2 * quarter}, {after:.4g} in the '
              f'last {quarter}{": GROWN" if grew else ""}')
        found += [name] * grew
    return found


def main() -> int:
    """Drive all day; return 1 if anything grew or was wrong."""
    from bench import Client, NodeProcess, wait_for
    from geometry_msgs.msg import TwistWithCovarianceStamped

    from odocal_ros.sim.scenarios import SimOptions, simulate
    args = parsed(__doc__, hours=(24.0, 'simulated'), legs=100,
                  speedup=(40.0, 'the node must keep up with it'), rate=(5.0, 'Hz of each topic'),
                  log=(Path, 'CSV, a row for each leg'))
    drives = [simulate(SimOptions(
        scenario='out_and_back', duration=DRIVE_S, imu_rate=args.rate, odometer_rate=args.rate,
        fix_rate=args.rate, odometer='speed', seed=seed, scale=1.02, imu_grade='industrial'))
        for seed in range(DRIVES)]
    looks: list[Look] = []
    with tempfile.TemporaryDirectory(prefix='odocal_soak_') as folder:
        node = NodeProcess('-p', f'output.directory:={folder}', '-p', 'use_sim_time:=true',
                           '-p', 'diagnostic_updater.period:=0.2')
        odometry = NodeProcess('-p', 'use_sim_time:=true', '-p', 'result.valid:=true', '-p',
                               f'result.scale_factor:={drives[0].truth.scale}', '-p',
                               'result.scale_factor_sigma:=0.001', module='odometry')
        client, poses = Client(), []
        client.node.create_subscription(TwistWithCovarianceStamped, 'odometry/twist',
                                        lambda _: poses.append(None), 100)
        try:
            every_s = max(DRIVE_S + 10, 3600 * args.hours / args.legs)
            day = Day(client, drives, args.speedup, every_s)
            wait_for(day.received, 'subscriptions')
            wait_for(lambda: client.node.count_subscribers('/odometer') == 2, 'those of odometry')
            wait_for(day.received, 'the time')
            for leg in range(1, args.legs + 1):
                looks.append(one_leg(day, client, node, odometry, poses, Path(folder), leg,
                                     drives[0].truth.scale))
                print(', '.join(f'{k} {v:.4g}' if isinstance(v, float) else f'{k} {v}'
                                for k, v in asdict(looks[-1]).items()), flush=True)
            code = node.end() or odometry.end()
        finally:
            node.end()
            odometry.end()
            client.close()
    if args.log:
        with args.log.open('w') as file:
            rows = csv.DictWriter(file, [f.name for f in fields(Look)])
            rows.writeheader()
            rows.writerows(map(asdict, looks))
    wrong = [look.leg for look in looks if look.verdict == 'accepted' and not look.sigmas < SIGMAS]
    print('\n'.join(line for line in odometry.lines if 'WARN' in line or 'ERROR' in line))
    print(f'{looks[-1].hour:.1f} h, {len(looks)} legs, exit {code}, '
          f'{sum(look.verdict == "accepted" for look in looks)} accepted, {len(wrong)} wrong')
    return int(bool(grown(looks) or wrong or code))


if __name__ == '__main__':
    sys.exit(main())
