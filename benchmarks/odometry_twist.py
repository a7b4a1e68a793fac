# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Hold the twist of the node ``odometry`` against the truth, over DDS, with a counter without header.

    python benchmarks/odometry_twist.py [--seconds 60] [--rate 100] [--busy 2] [--nice 0]

A publisher process sends the IMU (100 Hz, with header) and a counter (50 Hz, std_msgs/Int64, which
is stamped at arrival) of a simulated town drive in real time. ``--busy`` loops keep as many cores
at work. Printed: the share of twists whose forward speed is within two and three sigma of the
truth, at how much jitter of the arrivals, and the CPU of the node, of one core.
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

IMU_HZ, COUNTER_HZ = 100.0, 50.0
REST, BEFORE = 20.0, 4.0       # s, standstill that the drive begins with, part of it played
MOVING = 0.3                   # m/s, from which twists are judged
BUSY = 'while True: pass'


def drive_of(seconds):
    """Simulate the drive that is sent."""
    from odocal_ros.sim.scenarios import SimOptions, simulate
    return simulate(SimOptions(scenario='town', duration=max(REST + seconds + 60.0, 135.0), seed=2,
                               imu_rate=IMU_HZ, odometer_rate=COUNTER_HZ, imu_grade='industrial'))


def publish(seconds) -> None:
    """Send the drive in real time, stamped by the wall clock; print where its time begins."""
    from dataclasses import replace

    from player import by_now, Player, sent_of
    import rclpy

    from odocal_ros.bagio import encode
    drive = drive_of(seconds)
    rclpy.init()
    node = rclpy.create_node('sender')
    player = Player(node, {'imu': 'sensor_msgs/msg/Imu', 'odometer': 'std_msgs/msg/Int64'})
    while not player.matched():
        time.sleep(0.05)

    def messages(begin_ns):
        topics = {}
        for slot, pack in (('imu', encode.imu), ('odometer', encode.counter)):
            rows = getattr(drive, slot)
            stamps = rows.stamp_ns - drive.options.start_ns + begin_ns - round(
                (REST - BEFORE) * 1e9)
            topics[slot] = pack(slot, replace(rows, stamp_ns=stamps, received_ns=stamps))
        return sorted((one for slot, topic in topics.items() for one in sent_of(slot, topic)
                       if 0 <= one.stamp_ns - begin_ns < (BEFORE + seconds) * 1e9),
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


def measure(args) -> None:
    """Run node, sender and loops; print what came of it."""
    from bench import Client, NodeProcess
    from geometry_msgs.msg import TwistWithCovarianceStamped
    from live_load import cpu_s
    from rclpy.qos import QoSProfile
    drive = drive_of(args.seconds)
    truth = drive.truth
    with tempfile.NamedTemporaryFile('w', suffix='.yaml') as file:
        file.write('/**: {ros__parameters: {result: {scale_factor: ' f'{truth.scale!r}, '
                   f'scale_factor_sigma: {3e-4 * truth.scale!r}, yaw_mounting_angle: {truth.yaw}, '
                   f'yaw_mounting_angle_sigma: 0.002, pitch_mounting_angle: {truth.pitch}, '
                   'pitch_mounting_angle_sigma: 0.002, valid: true, stamp: "2026-01-01"}}}')
        file.flush()
        node = NodeProcess('--params-file', file.name, '-p', f'publish.rate:={args.rate}',
                           '-p', 'imu.grade:=industrial', module='odometry')
        client, twists = Client('odometry'), []
        client.node.create_subscription(TwistWithCovarianceStamped, 'odometry/twist',
                                        twists.append, QoSProfile(depth=5000))
        sender = subprocess.Popen([sys.executable, __file__, '--role', 'publish', '--seconds',
                                   str(args.seconds)], stdout=subprocess.PIPE, text=True)
        loops = []
        try:
            begin_ns = int(sender.stdout.readline())
            loops = [subprocess.Popen([sys.executable, '-c', BUSY],
                                      preexec_fn=lambda: os.nice(args.nice))
                     for _ in range(args.busy)]
            time.sleep(BEFORE)
            before, since = cpu_s(node.process.pid), time.monotonic()
            late = sender.stdout.readline().split()
            cpu = 100 * (cpu_s(node.process.pid) - before) / (time.monotonic() - since)
            sender.wait()
        finally:
            for process in (*loops, sender):
                process.kill()
            node.end()
            client.close()
    report(drive, twists, begin_ns)
    print(f'messages sent late by {late[0]} ms (median), {late[1]} ms (95 %), {late[2]} ms (most)')
    print(f'CPU of the node at {args.rate:g} Hz: {cpu:.1f} % of a core')
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
    parser.add_argument('--busy', type=int, default=0, help='loops')
    parser.add_argument('--nice', type=int, default=0, help='of the loops')
    parser.add_argument('--role', choices=('publish',), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.role == 'publish':
        publish(args.seconds)
    else:
        measure(args)


if __name__ == '__main__':
    main()
