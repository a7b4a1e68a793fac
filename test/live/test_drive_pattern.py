# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The node drive_pattern over DDS, with a robot that follows commands: it drives, and it stops."""

import contextlib
import math
import signal
import threading
import time
from types import SimpleNamespace
from unittest.mock import patch

from bench import Client, given, NodeProcess, wait_for
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
import pytest
from std_msgs.msg import Bool

from odocal_ros.live.drive_pattern import DrivePattern, FINAL_STOP_COMMANDS
from odocal_ros.live.process import CheckedNode

BOX = (-1.0, -1.0, 2.0, 1.0)
SETTINGS = {'speed': 1.0, 'rectangle': f'[{", ".join(map(str, BOX))}]', 'pattern': 'straight',
            'margin': 0.4, 'turn_rate': 3.0, 'acceleration': 2.0, 'rest': 0.1}
STEP_S = 0.02


class Robot:
    """A unicycle in a thread; it stands if the last command is older than 0.5 s."""

    def __init__(self, client: Client, kind: type = Twist) -> None:
        self.pose = [0.0, 0.0, 0.0]
        self.track: list[tuple[float, float]] = []
        self.commands: list[tuple[float, float]] = []
        self.blind = self.frozen = False
        self._at, self._over = 0.0, threading.Event()
        self._publisher = client.node.create_publisher(PoseStamped, 'pose', 1)
        self._bumper = client.node.create_publisher(Bool, 'bumper', 1)
        client.node.create_subscription(kind, 'cmd_vel', self._take, 10)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _take(self, message) -> None:
        twist = getattr(message, 'twist', message)
        self.commands.append((twist.linear.x, twist.angular.z))
        self._at = time.monotonic()

    def _run(self) -> None:
        while not self._over.wait(STEP_S):
            fresh = self.commands and time.monotonic() - self._at < 0.5
            speed, rate = self.commands[-1] if fresh and not self.frozen else (0.0, 0.0)
            x, y, heading = self.pose
            middle = heading + rate * STEP_S / 2
            self.pose = [x + speed * STEP_S * math.cos(middle),
                         y + speed * STEP_S * math.sin(middle), heading + rate * STEP_S]
            self.track.append(tuple(self.pose[:2]))
            if not self.blind:
                self._show()

    def _show(self) -> None:
        message = PoseStamped()
        message.pose.position.x, message.pose.position.y = self.pose[:2]
        message.pose.orientation.z = math.sin(self.pose[2] / 2)
        message.pose.orientation.w = math.cos(self.pose[2] / 2)
        self._publisher.publish(message)

    @contextlib.contextmanager
    def bumped(self):
        """Press the bumper during the block."""
        wait_for(self._bumper.get_subscription_count, 'the node at the bumper')
        self._bumper.publish(Bool(data=True))
        yield
        self._bumper.publish(Bool(data=False))

    def close(self) -> None:
        self._over.set()
        self._thread.join()


@contextlib.contextmanager
def ready(kind=Twist, before=lambda client: None, **settings):
    """Yield node, client and robot; end all.   before : called before the node starts."""
    with contextlib.ExitStack() as ends:
        client = Client('drive_pattern')
        ends.callback(client.close)
        robot = Robot(client, kind)
        ends.callback(robot.close)
        before(client)
        node = NodeProcess(*given(SETTINGS | settings), module='drive_pattern')
        ends.callback(node.end)
        wait_for(lambda: 'ready: ' in node.text, 'the node')
        yield node, client, robot


@contextlib.contextmanager
def driven(kind=Twist, **settings):
    """Yield node, client and moving robot; end all."""
    with ready(kind, **settings) as (node, client, robot):
        wait_for(lambda: client.call('start').success, 'a start')
        wait_for(lambda: (robot.commands or [(0.0, 0.0)])[-1] != (0.0, 0.0), 'a command')
        yield node, client, robot


def stopped(node, robot, why, within_s):
    """Check that the node stops the robot in time by several zero commands, then sends none."""
    began = time.monotonic()
    wait_for(lambda: f'stopped: {why}' in node.text, f'the stop by {why}')
    assert time.monotonic() - began < within_s
    wait_for(lambda: robot.commands[-5:] == [(0.0, 0.0)] * 5, 'zeros')
    time.sleep(1.5)
    count = len(robot.commands)
    time.sleep(0.3)
    assert len(robot.commands) == count
    assert robot.commands[-10:] == [(0.0, 0.0)] * 10


def test_a_pattern_is_driven_to_its_end_inside_the_rectangle():
    with driven() as (node, client, robot):
        assert not client.call('start').success     # the pattern is running
        stopped(node, robot, 'the pattern is complete', 60)
        x, y = zip(*robot.track, strict=True)
        # late commands: 0.1 s at 1 m/s
        assert BOX[0] + 0.2 < min(x) < BOX[0] + 0.5 < BOX[2] - 0.5 < max(x) < BOX[2] - 0.2
        assert BOX[1] + 0.2 < min(y) < max(y) < BOX[3] - 0.2
        assert max(speed for speed, _ in robot.commands) <= 1.0
        assert max(abs(rate) for _, rate in robot.commands) <= 3.0


# cause of a stop: how to produce it, and whether it refuses a start
CAUSES = {
    'no pose for 0.5 s': (lambda robot: patch.object(robot, 'blind', True), True),
    'the bumper is pressed': (Robot.bumped, True),
    'the robot is outside the rectangle, at x': (
        lambda robot: patch.object(robot, 'pose', [0.0, 1.2, 0.0]), True),
    'the pose has not changed for 2 s': (
        lambda robot: patch.object(robot, 'frozen', True), False)}


def test_each_cause_stops_the_robot_and_a_new_start_continues():
    with driven() as (node, client, robot):
        for why, (cause, refused) in CAUSES.items():
            with cause(robot):
                stopped(node, robot, why, 10)
                if refused:
                    answer = client.call('start')
                    assert not answer.success
                    assert why in answer.message
            wait_for(lambda: client.call('start').success, f'a start after {why}')


def test_the_service_and_a_timeout_stop_the_robot():
    with driven(kind=TwistStamped, stamped='true', timeout=5.0) as (node, client, robot):
        assert client.call('stop').message == 'stopped'
        stopped(node, robot, '~/stop', 5)
        assert 'no pattern was running' in client.call('stop').message
        assert client.call('start').success
        stopped(node, robot, 'timeout of 5 s', 10)


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_node_that_ends_stops_the_robot(number):
    with driven() as (node, _, robot):
        assert node.end(number) == 0
        assert 'stopped: the node ends' in node.text
        wait_for(lambda: robot.commands[-3:] == [(0.0, 0.0)] * 3, 'zeros')
        assert 'Traceback' not in node.text


@pytest.mark.parametrize(('commands_left', 'zeros'), [(3, 1 + FINAL_STOP_COMMANDS), (0, 0)])
def test_a_node_that_ends_during_a_stop_repeats_zero_commands(monkeypatch, commands_left, zeros):
    node, sent = object.__new__(DrivePattern), []
    node._context = SimpleNamespace(ok=lambda: True)
    node._route, node._stop_commands_left = (), commands_left
    node._send = lambda *command: sent.append(command)
    monkeypatch.setattr(CheckedNode, 'destroy_node', lambda self: None, raising=False)
    node.destroy_node()
    assert sent == [(0.0, 0.0)] * zeros


def test_a_start_is_refused_if_another_node_publishes_commands():
    def other(client):
        client.node.create_publisher(Twist, 'cmd_vel', 1)
    with ready(before=other) as (_, client, robot):
        wait_for(lambda: client.call('start').message == (
            '/cmd_vel has 1 other publisher: end the other node, or remap one of them'), 'refusal')
        assert not robot.commands        # nothing is sent before a start


@pytest.mark.parametrize(('settings', 'message'), [
    ({}, 'speed is not set; required: the speed limit, m/s: -p speed:=0.2'),
    ({'speed': 0.2}, 'rectangle has 0 values; required'),
    ({'speed': 0.2, 'rectangle': '[0.0, 0.0, 1.0, 1.0]'}, 'the pattern has 0.00 m, required'),
    ({'speed': 9.0}, 'speed')])
def test_missing_or_unusable_settings_are_an_error_at_start_up(settings, message):
    node = NodeProcess(*given(settings or {'pattern': 'square'}), module='drive_pattern')
    assert node.wait() == 1
    assert message in node.text
    assert 'Traceback' not in node.text
