# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
What the node costs while it records: beside a bare typed subscriber of the same topics.

    python benchmarks/live_load.py [--seconds 60] [--imu 400] [--odometer 50] [--fix 5]
                                    [--no-journal]

A publisher process sends IMU, speed and fixes of a simulated town drive; the calibrator and a bare
rclpy node that subscribes to the same topics, typed, with an empty callback, run beside it, all at
once. Printed, each figure beside its goal where there is one: CPU of one core of the node before
anything comes (status and diagnostics with one subscriber, and polling) and in a
leg; that of the bare subscriber in the same seconds; messages lost in the leg and while its result
is computed; how often there was a new running estimate; the latency of service calls after these
seconds, ten a second for CALLS_S. No loss is to be seen at --imu 4000 --odometer 250 --fix 25.
"""

import argparse
from pathlib import Path
import statistics
import subprocess
import sys
import tempfile
import time

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'test' / 'live'))

REST, BEFORE = 20.0, 15.0      # s, standstill that the drive begins with, part of it played
SETTLED_S, IDLE_S, CALLS_S = 3.0, 20.0, 10.0     # s: of idle nodes, and of calls in a leg
GOAL_LOST, GOAL_IDLE, GOAL_RATIO = 0, 1.0, 0.6   # messages, % of a core, of the bare CPU
TICKS = 100   # per second in /proc/<pid>/stat, on every Linux


def publish(rates, seconds) -> None:
    """Send a town drive from just before its first start, by its own stamps, until ended."""
    from player import messages_of, part
    import rclpy
    from rclpy.qos import QoSProfile

    from odocal_ros.live.messages import message_class
    from odocal_ros.sim.scenarios import SimOptions, simulate
    drive = simulate(SimOptions(scenario='town', duration=REST + seconds + 60.0, odometer='speed',
                                **dict(zip(('imu_rate', 'odometer_rate', 'fix_rate'), rates,
                                           strict=True))))
    types, messages = messages_of(drive)
    messages = part(messages, REST - BEFORE, REST + seconds + 60.0)
    rclpy.init()
    node = rclpy.create_node('load')
    names = {'imu': 'imu/data', 'odometer': 'odometer', 'fix': 'fix'}
    publishers = {slot: node.create_publisher(message_class(kind), names[slot],
                                              QoSProfile(depth=1000))
                  for slot, kind in types.items()}
    while any(publisher.get_subscription_count() < 2 for publisher in publishers.values()):
        time.sleep(0.05)   # both listeners: nothing sent before may count as lost
    begin, first_ns, last, sent = time.monotonic(), messages[0].stamp_ns, 0.0, dict.fromkeys(
        names, 0)
    try:
        for one in messages:
            now = time.monotonic() - begin
            while now < (one.stamp_ns - first_ns) * 1e-9:
                time.sleep(0.0005)
                now = time.monotonic() - begin
            publishers[one.slot].publish(one.raw)
            sent[one.slot] += 1
            if now > last + 0.2:
                last = now
                print(*sent.values(), flush=True)
    except (KeyboardInterrupt, Exception):
        pass
    print(*sent.values(), flush=True)


def listen() -> None:
    """Subscribe typed with empty callbacks; count nothing but messages."""
    from geometry_msgs.msg import TwistStamped
    import rclpy
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import Imu, NavSatFix
    rclpy.init()
    node = rclpy.create_node('bare')
    qos = QoSProfile(depth=5000, reliability=ReliabilityPolicy.BEST_EFFORT)

    def nothing(_):
        return

    for kind, name in ((Imu, 'imu/data'), (TwistStamped, 'odometer'), (NavSatFix, 'fix')):
        node.create_subscription(kind, name, nothing, qos)
    try:
        rclpy.spin(node)
    except BaseException:
        return


def cpu_s(pid: int) -> float:
    """Return seconds of CPU that a process has used, all its threads."""
    fields = Path(f'/proc/{pid}/stat').read_text().rsplit(')', 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def measure(args) -> None:
    """Run the three processes and print what they used."""
    from bench import Client, NodeProcess, wait_for
    rates = (args.imu, args.odometer, args.fix)
    me = [sys.executable, __file__]
    folder = tempfile.mkdtemp()
    node = NodeProcess('-p', f'output.directory:={folder}',
                       *(('-p', 'journal.max_bytes:=0') if args.no_journal else ()))
    bare = subprocess.Popen([*me, '--role', 'listen'])
    client = Client()
    client.until(state='waiting')
    time.sleep(SETTLED_S)
    idle = cpu_percent((node.process,), IDLE_S)
    load = subprocess.Popen([*me, '--role', 'publish', '--rates', *map(str, rates), '--seconds',
                             str(args.seconds)], stdout=subprocess.PIPE, text=True)
    try:
        client.until(state='idle')   # so early that the whole drive is in the leg
        wait_for(lambda: float(client.status['imu_rate_hz']) > 0.9 * args.imu, 'the full rate')
        assert client.call('start_leg').success
        used = cpu_percent((node.process, bare), args.seconds)
        latencies = called(client)
        asked = time.perf_counter()
        client.result(client.ask('stop_leg'))    # messages come while it is computed
        computed = time.perf_counter() - asked
        load.terminate()
        sent = [int(x) for x in load.communicate()[0].split()[-3:]]
        report(args, client, sent, (*idle, *used), latencies)
        print(f'result of stop_leg after {computed:.1f} s')
    finally:
        for process in (load, bare):
            process.terminate()
        node.end()
        client.close()


def cpu_percent(processes, seconds: float) -> list[float]:
    """Return the CPU of one core that each process takes from now on for a time, %."""
    begin, before = time.monotonic(), [cpu_s(p.pid) for p in processes]
    time.sleep(seconds)
    took = time.monotonic() - begin
    return [100 * (cpu_s(p.pid) - b) / took for p, b in zip(processes, before, strict=True)]


def called(client) -> list[float]:
    """Return the durations of service calls, ms."""
    latencies, until = [], time.monotonic() + CALLS_S
    while time.monotonic() < until:
        asked = time.perf_counter()
        client.call('start_leg')     # answers 'recording since'
        latencies.append((time.perf_counter() - asked) * 1e3)
        time.sleep(0.1)
    return sorted(latencies)


def told(what: str, figure: float, unit: str, goal: float) -> None:
    """Print a figure beside its goal."""
    print(f'{what:<58} {figure:8.2f} {unit:<3} goal {goal:g}'
          f'{"" if figure <= goal else "   MISSED"}')


def report(args, client, sent, used, latencies) -> None:
    """Print the figures; ``used`` by the node idle and in a leg, and by the bare subscriber, %."""
    time.sleep(2.5)   # the last /diagnostics comes within its period of 1 s
    health = [client.health[f'calibrator: {name}'] for name in ('imu', 'odometer', 'gnss')]
    print(f'{args.imu:g} / {args.odometer:g} / {args.fix:g} Hz (IMU, speed, fixes), '
          f'{args.seconds:g} s in a leg; sent {sent}, received '
          f'{[int(h["messages"]) for h in health]}')
    told('messages lost, by sequence numbers', sum(int(h['dropped']) for h in health), '',
         GOAL_LOST)
    told('idle: CPU of the node, of one core', used[0], '%', GOAL_IDLE)
    told(f'in a leg: CPU {used[1]:.1f} % over a bare typed subscriber, {used[2]:.1f} %',
         used[1] / used[2], '', GOAL_RATIO)
    values = [v for v in (s['estimate_scale_factor'] for s in client.statuses) if v != 'nan']
    ages = [float(s['estimate_age_s']) for s in client.statuses]
    print(f'running estimates meanwhile: {len(dict.fromkeys(values))}, the oldest '
          f'{max((a for a in ages if a == a), default=0.0):.0f} s old')
    print(f'service call in a leg, {len(latencies)} calls: median '
          f'{statistics.median(latencies):.1f} ms, p90 {latencies[int(0.9 * len(latencies))]:.1f} '
          f'ms, max {latencies[-1]:.1f} ms')


def main() -> None:
    """Run one role; without one, measure."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--seconds', type=float, default=60.0)
    parser.add_argument('--imu', type=float, default=400.0)
    parser.add_argument('--odometer', type=float, default=50.0)
    parser.add_argument('--fix', type=float, default=5.0)
    parser.add_argument('--no-journal', action='store_true')
    parser.add_argument('--role', choices=('publish', 'listen'), help=argparse.SUPPRESS)
    parser.add_argument('--rates', nargs=3, type=float, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.role == 'publish':
        publish(args.rates, args.seconds)
    elif args.role == 'listen':
        listen()
    else:
        measure(args)


if __name__ == '__main__':
    main()
