# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The node that drives a robot along a calibration pattern (``pattern.py``)."""

from functools import partial
import math
import signal
import time
from typing import Any

from geometry_msgs.msg import Twist, TwistStamped
from rclpy.executors import Executor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

from odocal_ros import pattern
from odocal_ros.errors import BadConfig
from odocal_ros.live import params
from odocal_ros.live.messages import message_class
from odocal_ros.live.process import CheckedNode, run
from odocal_ros.output.value_text import counted
from odocal_ros.settings.node_configs import PatternConfig

PERIOD_S = 0.05       # judgement: base controllers stop after 0.2 s or more without a command
STOP_COMMANDS = 20            # judgement: zero commands at a stop, since one may be lost
STUCK_S = 2.0         # judgement: twice the time of the slowest robot for a measurable motion
FINAL_STOP_COMMANDS, LAST_PERIOD_S = 5, 0.02       # judgement: zero commands of an ending node
HELP = """\
usage: drive_pattern --ros-args -p speed:=M_PER_S -p 'rectangle:=[X, Y, X, Y]' [-p NAME:=VALUE]

Drives a robot along a pattern inside a rectangle, for a calibration (a ROS 2 node). It moves the
robot after ~/start only. Keep an emergency stop at hand.

subscribes   pose (geometry_msgs/PoseStamped, or pose_type), bumper (std_msgs/Bool)
publishes    cmd_vel (geometry_msgs/Twist, or TwistStamped with stamped)
services     ~/start, ~/stop   (std_srvs/srv/Trigger)
settings     parameters, all described in config/drive_pattern.yaml"""


class DrivePattern(CheckedNode):
    """Sends velocity commands while it drives or stops the robot, nothing otherwise."""

    default_name = 'drive_pattern'

    def _build(self) -> None:
        self.config: PatternConfig = params.declare_settings(self, PatternConfig)
        if math.isnan(self.config.speed):
            raise BadConfig('speed is not set; required: the speed limit, m/s: -p speed:=0.2')
        self._rectangle = pattern.rectangle_of(self.config)
        pattern.route_of(self.config, self._rectangle[:2])      # raises now, not at ~/start
        self._pose: pattern.Pose | None = None
        self._pose_time = -math.inf     # of its arrival; all times are s, steady clock
        self._is_bumper_pressed = self._is_ending = False
        self._route: tuple[pattern.Piece, ...] = ()     # empty: the robot is not driven
        self._progress, self._started_s, self._stop_commands_left = pattern.Progress(), 0.0, 0
        # pose and time at which the robot last moved
        self._last_motion: tuple[pattern.Pose, float] | None = None
        sensor = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        self.create_subscription(message_class(self.config.pose_type), 'pose', self._receive_pose,
                                 sensor)
        self.create_subscription(Bool, 'bumper', self._receive_bumper, sensor)
        self._publisher = self.create_publisher(TwistStamped if self.config.stamped else Twist,
                                                'cmd_vel', 1)
        self.create_service(Trigger, '~/start', self._start)
        self.create_service(Trigger, '~/stop', self._stop)
        self.add_on_set_parameters_callback(params.refuse_after_start(PatternConfig))
        self.steady_timer(PERIOD_S, self._tick)
        self.get_logger().info(f'ready: {self.config.pattern} in the rectangle {self._rectangle}, '
                               f'at most {self.config.speed:g} m/s; call ~/start')

    def spin(self, executor: Executor) -> None:
        """Process callbacks until a signal; the robot is stopped before the context ends."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._end)
        while self.context.ok() and not self._is_ending:
            executor.spin_once(timeout_sec=PERIOD_S)

    def destroy_node(self) -> None:
        if getattr(self, '_route', ()) or getattr(self, '_stop_commands_left', 0):
            self._halt('the node ends')
            for _ in range(FINAL_STOP_COMMANDS if self.context.ok() else 0):
                self._send(0.0, 0.0)
                time.sleep(LAST_PERIOD_S)
        super().destroy_node()  # type: ignore[no-untyped-call]

    def _end(self, *_: object) -> None:
        self._is_ending = True

    def _receive_pose(self, message: Any) -> None:
        pose = message.pose if hasattr(message.pose, 'position') else message.pose.pose
        q = pose.orientation
        heading = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))
        self._pose = pose.position.x, pose.position.y, heading
        self._pose_time = time.monotonic()

    def _receive_bumper(self, message: Bool) -> None:
        self._is_bumper_pressed = message.data
        if self._route:
            self._tick()        # at once

    def _stop_reason(self) -> str:
        now = time.monotonic()
        driven_s = now - self._started_s if self._route else 0.0
        return pattern.stop_cause(
            self._pose, now - self._pose_time, self._rectangle, self._is_bumper_pressed, driven_s,
            self.config.timeout)

    def _start(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        reason = 'a pattern is already running' if self._route else self._stop_reason()
        others = self.count_publishers(self._publisher.topic_name) - 1
        if not reason and others:
            reason = (f'{self._publisher.topic_name} has {counted(others, "other publisher")}: '
                      'end the other node, or remap one of them')
        response.success, response.message = not reason, reason
        if reason:
            self.get_logger().warning(f'~/start refused: {reason}')
            return response
        assert self._pose is not None
        self._route = pattern.route_of(self.config, self._pose[:2])
        self._progress, self._started_s = pattern.Progress(), time.monotonic()
        self._stop_commands_left = 0
        self._last_motion = None
        response.message = (f'driving: {self.config.pattern}, '
                            f'{sum(piece.length for piece in self._route):.1f} m')
        self.get_logger().info(response.message)
        return response

    def _stop(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = True
        response.message = 'stopped' if self._route else 'no pattern was running; stopped'
        self._halt('~/stop')
        return response

    def _halt(self, reason: str) -> None:
        """Stop the robot: a zero command now, and more at the next ticks."""
        if self._route:
            self.get_logger().info(f'stopped: {reason}')
        self._route, self._stop_commands_left = (), STOP_COMMANDS
        if self.context.ok():
            self._send(0.0, 0.0)

    def _tick(self) -> None:
        """Send a command while a pattern is running; then zeros, then nothing."""
        if not self._route:
            if self._stop_commands_left:
                self._stop_commands_left -= 1
                self._send(0.0, 0.0)
            return
        if reason := self._stop_reason():
            self._halt(reason)
            return
        assert self._pose is not None
        speed, rate, self._progress = pattern.command(self._route, self._progress, self._pose,
                                                      time.monotonic(), self.config)
        if self._progress.piece == len(self._route):
            self._halt('the pattern is complete')
        elif self._is_stuck(is_commanded=bool(speed or rate)):
            self._halt(f'the pose has not changed for {STUCK_S:g} s: the wheels are blocked, or '
                       'the position is frozen')
        else:
            self._send(speed, rate)

    def _is_stuck(self, is_commanded: bool) -> bool:
        """Return True if the robot has not moved for STUCK_S although it is commanded to."""
        pose, now = self._pose, time.monotonic()
        assert pose is not None
        if not is_commanded or self._last_motion is None or pattern.has_moved(
                self._last_motion[0], pose):
            self._last_motion = pose, now
        return now - self._last_motion[1] > STUCK_S

    def _send(self, speed: float, rate: float) -> None:
        twist = Twist()
        twist.linear.x, twist.angular.z = float(speed), float(rate)
        if self.config.stamped:
            stamped = TwistStamped(twist=twist)
            stamped.header.stamp = self.get_clock().now().to_msg()
            stamped.header.frame_id = 'base_link'
        self._publisher.publish(stamped if self.config.stamped else twist)


main = partial(run, DrivePattern, HELP)
