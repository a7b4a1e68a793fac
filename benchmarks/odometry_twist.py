# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Hold the twist of the node ``odometry`` against the truth, over DDS, with a counter without header.

    python benchmarks/odometry_twist.py [--seconds 60] [--rate 100] [--counter 50] [--busy 2]
                                        [--nice 0] [--beside OTHER_CHECKOUT]

A publisher process sends the IMU (100 Hz, with header) and a counter (std_msgs/Int64, which is
stamped at arrival) of a simulated town drive in real time. ``--busy`` loops keep as many cores at
work. Printed: the share of twists whose forward speed is within two and three sigma of the truth,
at how much jitter of the arrivals, and the CPU of the node, of one core. Two nodes without
odometry run beside it, on the same topics, and publish as many messages of the same types and
sizes, serialised before: ``polling`` takes the messages as the node does, ``spinning`` has them
from the executor of rclpy. What they use is the cost of ROS alone. With ``--beside`` the node of
another checkout runs beside them, too.
"""

import argparse
import os
from pathlib import Path
import subprocess
import sys
import tempfile
import time

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'test' / 'live'))

IMU_HZ = 100.0
REST, BEFORE = 20.0, 4.0       # s, standstill that the drive begins with, part of it played
MOVING = 0.3                   # m/s, from which twists are judged
BUSY = 'while True: pass'
WITHOUT = ('polling', 'spinning')      # nodes without odometry


def drive_of(args):
    """Simulate the drive that is sent."""
    from odocal_ros.sim.scenarios import SimOptions, simulate
    return simulate(SimOptions(
        scenario='town', duration=max(REST + args.seconds + 60.0, 135.0), seed=2, imu_rate=IMU_HZ,
        odometer_rate=args.counter, imu_grade='industrial'))


def publish(args) -> None:
    """Send the drive in real time, stamped by the wall clock; print where its time begins."""
    from dataclasses import replace

    from player import by_now, Player, sent_of
    import rclpy

    from odocal_ros.bagio import encode
    drive = drive_of(args)
    rclpy.init()
    node = rclpy.create_node('sender')
    player = Player(node, {'imu': 'sensor_msgs/msg/Imu', 'odometer': 'std_msgs/msg/Int64'})
    while any(one.get_subscription_count() < 1 + len(args.beside) + len(WITHOUT)
              for one in player.publishers.values()):
        time.sleep(0.05)

    def messages(begin_ns):
        topics = {}
        for slot, pack in (('imu', encode.imu), ('odometer', encode.counter)):
            rows = getattr(drive, slot)
            stamps = rows.stamp_ns - drive.options.start_ns + begin_ns - round(
                (REST - BEFORE) * 1e9)
            topics[slot] = pack(slot, replace(rows, stamp_ns=stamps, received_ns=stamps))
        return sorted((one for slot, topic in topics.items() for one in sent_of(slot, topic)
                       if 0 <= one.stamp_ns - begin_ns < (BEFORE + args.seconds) * 1e9),
                      key=lambda one: one.stamp_ns)
    begin_ns, sent = by_now(messages)
    print(begin_ns - round((REST - BEFORE) * 1e9), flush=True)
    late = []
    for one in sent:
        time.sleep(max(0.0, (one.stamp_ns - time.time_ns()) * 1e-9))
        player.publishers[one.slot].publish(one.raw)
        late.append((time.time_ns() - one.stamp_ns) * 1e-6)
    late.sort()
    print(*(f'{late[int(share * (len(late) - 1))]:.2f}' for share in (0.5, 0.95, 1.0)), flush=True)
    time.sleep(1.0)


def relay(args) -> None:
    """Publish a message of each type at ``--rate`` for what comes, without any odometry."""
    from geometry_msgs.msg import TwistWithCovarianceStamped
    from nav_msgs.msg import Odometry
    import rclpy
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import Imu
    from std_msgs.msg import Int64

    from odocal_ros.live.messages import MessageQueue
    from odocal_ros.live.odometry import CHECK_PERIOD_S, EXECUTOR_PERIOD_S, TemplatePublisher
    rclpy.init()
    node = rclpy.create_node(args.role)
    publishers = [(TemplatePublisher(node, f'{args.role}/{name}', kind()), bytes(8 * size))
                  for name, kind, size in (('odometry', Odometry, 85),
                                           ('twist', TwistWithCovarianceStamped, 42))]
    qos = QoSProfile(depth=5000, reliability=ReliabilityPolicy.BEST_EFFORT)
    due = 0.0

    def send(_) -> None:
        nonlocal due
        due += args.rate / IMU_HZ
        for publisher, numbers in publishers if due > 1.0 - 1e-9 else ():
            publisher.send(time.time_ns(), numbers)
        due %= 1.0 - 1e-9

    topics = ((Int64, 'odometer', lambda _: None), (Imu, 'imu/data', send))
    if args.role == 'spinning':
        for kind, name, callback in topics:
            node.create_subscription(kind, name, callback, qos, raw=True)
        rclpy.spin(node)
    waiting = []
    for kind, name, callback in topics:
        waiting.append((MessageQueue(node), callback))
        waiting[-1][0].subscribe(kind, name, qos)
    executor, serve_at = rclpy.executors.SingleThreadedExecutor(), 0.0
    executor.add_node(node)
    while rclpy.ok():
        until = time.monotonic() + CHECK_PERIOD_S
        for messages, callback in waiting:
            for raw in messages.take()[0]:
                callback(raw)
        if until > serve_at:
            serve_at = until + EXECUTOR_PERIOD_S
            executor.spin_once(timeout_sec=0.0)
        time.sleep(max(0.0, until - time.monotonic()))


def used_s(pid: int) -> tuple[float, float]:
    """Return seconds of CPU of a process's main thread, and of its others."""
    of = {one.name: int((one / 'schedstat').read_text().split()[0]) * 1e-9
          for one in Path(f'/proc/{pid}/task').iterdir()}
    main = of.pop(str(pid))
    return main, sum(of.values())


def measure(args) -> None:
    """Run node, sender and loops; print what came of it."""
    from bench import Client, NodeProcess
    from geometry_msgs.msg import TwistWithCovarianceStamped
    from nav_msgs.msg import Odometry
    from rclpy.qos import QoSProfile

    from odocal_ros.live.messages import Gate
    drive = drive_of(args)
    truth = drive.truth
    with tempfile.NamedTemporaryFile('w', suffix='.yaml') as file:
        file.write('/**: {ros__parameters: {result: {scale_factor: ' f'{truth.scale!r}, '
                   f'scale_factor_sigma: {3e-4 * truth.scale!r}, yaw_mounting_angle: {truth.yaw}, '
                   f'yaw_mounting_angle_sigma: 0.002, pitch_mounting_angle: {truth.pitch}, '
                   'pitch_mounting_angle_sigma: 0.002, valid: true, stamp: "2026-01-01"}}}')
        file.flush()
        given = ('--params-file', file.name, '-p', f'publish.rate:={args.rate}', '-p',
                 'imu.grade:=industrial')
        node = NodeProcess(*given, module='odometry')
        others = [NodeProcess(*given, '-r', '__node:=beside', '-r', 'odometry:=beside/odometry',
                              '-r', 'odometry/twist:=beside/twist', module='odometry',
                              before=f'import sys; sys.path.insert(0, {folder!r})\n')
                  for folder in args.beside]
        client, twists = Client('odometry'), []
        client.node.create_subscription(TwistWithCovarianceStamped, 'odometry/twist',
                                        twists.append, QoSProfile(depth=5000))
        me = [sys.executable, __file__, '--seconds', str(args.seconds), '--rate', str(args.rate),
              '--counter', str(args.counter), *(f'--beside={one}' for one in args.beside)]
        without = [subprocess.Popen([*me, '--role', role]) for role in WITHOUT]
        names = ['odometry', *args.beside, *WITHOUT]
        unread = Gate()       # each node's messages are sent to a listener that leaves them
        for kind, topic in ((Odometry, 'odometry'), *(
                pair for role in (*WITHOUT, 'beside') for pair in (
                    (Odometry, f'{role}/odometry'),
                    (TwistWithCovarianceStamped, f'{role}/twist')))):
            client.node.create_subscription(kind, topic, print, 1, raw=True, callback_group=unread)
        sender = subprocess.Popen([*me, '--role', 'publish'], stdout=subprocess.PIPE, text=True)
        loops = []
        pids = [one.pid for one in (node.process, *(one.process for one in others), *without)]
        try:
            begin_ns = int(sender.stdout.readline())
            loops = [subprocess.Popen([sys.executable, '-c', BUSY],
                                      preexec_fn=lambda: os.nice(args.nice))
                     for _ in range(args.busy)]
            time.sleep(BEFORE)
            before, since = [used_s(pid) for pid in pids], time.monotonic()
            late = sender.stdout.readline().split()
            took = time.monotonic() - since
            used = [used_s(pid) for pid in pids]
            sender.wait()
        finally:
            for process in (*loops, *without, sender):
                process.kill()
            for one in (node, *others):
                one.end()
            client.close()
    report(drive, twists, begin_ns)
    print(f'messages sent late by {late[0]} ms (median), {late[1]} ms (95 %), {late[2]} ms (most)')
    print(f'CPU of a core, IMU {IMU_HZ:g} Hz, counter {args.counter:g} Hz, publish.rate '
          f'{args.rate:g}:')
    for name, last, first in zip(names, used, before, strict=True):
        main, others = (100 * (b - a) / took for a, b in zip(first, last, strict=True))
        print(f'{name:10} {main + others:5.1f} %: Python {main:.1f} %, threads of the middleware '
              f'{others:.1f} %')
    print('\n'.join(node.lines[4:]))


def report(drive, twists, begin_ns) -> None:
    """Print the shares of twists within their sigmas."""
    import numpy as np
    t = np.array([m.header.stamp.sec * 10**9 + m.header.stamp.nanosec - begin_ns
                  for m in twists]) * 1e-9
    fine = np.arange(0.0, drive.motion.duration, 1e-3)
    path = np.concatenate([[0.0], np.cumsum(drive.motion.at(fine).speed[1:] * 1e-3)])
    true = np.diff(np.interp(t, fine, path)) / np.diff(t)
    error = np.array([m.twist.twist.linear.x for m in twists])[1:] - true
    sigma = np.sqrt([m.twist.covariance[0] for m in twists])[1:]
    moving = np.abs(true) > MOVING
    if not moving.any():
        print(f'none of {len(twists)} twists is in motion: the node did not keep up')
        return
    ratio = np.abs(error[moving]) / sigma[moving]
    print(f'{moving.sum()} twists in motion: {np.mean(ratio <= 2):.1%} within 2 sigma, '
          f'{np.mean(ratio > 3):.1%} beyond 3, worst {ratio.max():.1f}; error '
          f'{np.sqrt(np.mean(error[moving]**2)):.3f} m/s rms, sigma '
          f'{np.median(sigma[moving]):.3f} m/s (median)')


def main() -> None:
    """Run one role; without one, measure."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--seconds', type=float, default=60.0)
    parser.add_argument('--rate', type=float, default=100.0, help='publish.rate, Hz')
    parser.add_argument('--counter', type=float, default=50.0, help='Hz')
    parser.add_argument('--busy', type=int, default=0, help='loops')
    parser.add_argument('--nice', type=int, default=0, help='of the loops')
    parser.add_argument('--beside', action='append', default=[], help='folder')
    parser.add_argument('--role', choices=('publish', *WITHOUT), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.role == 'publish':
        publish(args)
    elif args.role:
        relay(args)
    else:
        measure(args)


if __name__ == '__main__':
    main()
