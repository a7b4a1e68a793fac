# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The node that applies a calibration: odometer and IMU in, odometry with covariance out."""

from collections.abc import Callable
from functools import partial
import re
import struct
import time
from typing import Any

from geometry_msgs.msg import TransformStamped, TwistWithCovarianceStamped
from nav_msgs.msg import Odometry as OdometryMessage
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.executors import Executor
from rclpy.node import Node
from rclpy.serialization import serialize_message
from std_msgs.msg import Header

from odocal_ros.apply.odometry import Odometry, RESTARTS, stamp_difference_text
from odocal_ros.apply.pose import Pose, TWIST_OFFSET
from odocal_ros.apply.vehicle import vehicle_of
from odocal_ros.data.inputs import WHEELS
from odocal_ros.errors import BadConfig
from odocal_ros.live import params
from odocal_ros.live.console import MAX_MISSING_LOG_INTERVAL_NS, MISSING_LOG_DELAY_NS, TopicReport
from odocal_ros.live.messages import message_class
from odocal_ros.live.process import CheckedNode, run
from odocal_ros.live.topic_input import Input, SEARCH_PERIOD_S
from odocal_ros.messages.cdr import layout_of
from odocal_ros.messages.message_fields import types_of
from odocal_ros.safe_io.text_formats import error_text
from odocal_ros.settings.node_configs import ApplyConfig, OdomFrames

# judgement, all in s: period of checks for a due pose (its largest delay), of the executor (which
# costs most CPU), and of computations while odometer data are missing
CHECK_PERIOD_S, EXECUTOR_PERIOD_S, RECKONING_PERIOD_S = 0.02, 0.2, 0.2
LOG_INTERVAL_NS = 10 * 10**9      # judgement: between two log lines of one kind
HELP = """\
usage: odometry --ros-args --params-file CALIBRATION.yaml [-p NAME:=VALUE] [-r FROM:=TO] ...

Applies a calibration that 'odocal replay' or the calibrator wrote: dead reckoning of a vehicle by
its odometer and IMU, with a covariance (a ROS 2 node).

subscribes   imu/data, odometer; if configured odometer_right
             (another name: -r odometer:=/your/topic)
publishes    odometry (nav_msgs/Odometry), odometry/twist
             (geometry_msgs/TwistWithCovarianceStamped); with publish_tf /tf
settings     parameters, all described in config/odometry.yaml"""


class TemplatePublisher:
    """
    Publishes copies of a serialised message with another stamp and other numbers.

    Setting the fields of a message object and serialising it takes many times as long. message :
    the template with its frames; only 64-bit floats follow its last string.
    """

    def __init__(self, node: Node, topic: str, message: Any) -> None:
        raw = serialize_message(message)      # without the padding after the message
        package, name = type(message).__module__.split('.')[0], type(message).__name__
        layout = layout_of(f'{package}/msg/{name}', raw)
        assert layout is not None
        self._raw = raw[:layout.size]
        self._publisher = node.create_publisher(
            type(message), topic, 10,
            event_callbacks=PublisherEventCallbacks(use_default_callbacks=False))

    def send(self, stamp_ns: int, values: bytes) -> None:
        """Publish with a stamp, ns, and ``values``: all floats in order, little endian."""
        stamp = struct.pack('<iI', *divmod(stamp_ns, 10**9))
        self._publisher.publish(self._raw[:4] + stamp + self._raw[12:-len(values)] + values)


class OdometryNode(CheckedNode):
    """Feeds the inputs of the calibrator to ``Odometry`` and publishes its poses on two topics."""

    default_name = 'odometry'

    def _build(self) -> None:
        self.config = params.declare_settings(self, ApplyConfig)
        calibration = params.declare_results(self, params.ODOMETRY_UNITS)
        if calibration is None or not calibration.is_valid:
            refusal = 'no calibration is given' if calibration is None else (
                f'the calibration of {calibration.stamp} was rejected')
            raise BadConfig(f'{refusal}: start with --ros-args --params-file FILE, a '
                            'calibration.yaml that odocal replay or the calibrator wrote')
        vehicle = vehicle_of(calibration.estimates, self.config)
        for text in vehicle.assumptions:
            self.get_logger().warning(text)
        self._odometry = Odometry(vehicle, self.config)
        wheels = WHEELS[:2] if self.config.odometer.has_two_topics else WHEELS[:1]
        self._inputs = {slot: Input(self, slot, types_of(slot, self.config.odometer))
                        for slot in ('imu', *wheels)}
        params.check_qos(self, (source.topic for source in self._inputs.values()))
        for source in self._inputs.values():
            source.check_type(self.config)
        frames = self.config.frames
        self._pose = TemplatePublisher(self, 'odometry', OdometryMessage(
            header=Header(frame_id=frames.odom), child_frame_id=frames.base))
        self._twist = TemplatePublisher(self, 'odometry/twist', TwistWithCovarianceStamped(
            header=Header(frame_id=frames.base)))
        # steady times, ns: last search for publishers, next log of missing inputs (0: none is due)
        self._searched_ns = self._log_due_ns = 0
        self._has_published, self._pause_ns = False, MISSING_LOG_DELAY_NS
        self._logged_ns: dict[str, int] = {}      # last log of each kind of text
        self._topics = TopicReport()
        self.add_on_set_parameters_callback(params.refuse_after_start(ApplyConfig))
        self._send_transform = self._transform_sender() if self.config.publish_tf else None
        self._due_ns = self._reckoned_ns = 0      # next possible pose, last computation
        self._timer = self.steady_timer(CHECK_PERIOD_S, self._run_cycle)
        self.get_logger().info(f'applies the {calibration.as_text("")}')

    def spin(self, executor: Executor) -> None:
        """Take messages when a pose may be due; the executor handles the rest at a low rate."""
        self.destroy_timer(self._timer)      # it is only for nodes in other executors
        next_executor_s = 0.0
        while self.context.ok():
            next_check_s = time.monotonic() + CHECK_PERIOD_S
            self._run_cycle()
            until = max(next_check_s, min(self._due_ns * 1e-9, next_executor_s))
            if any(source.queue.gate.is_open for source in self._inputs.values()):
                while (remaining_s := until - time.monotonic()) > 0:    # it takes the messages
                    executor.spin_once(timeout_sec=remaining_s)
                continue
            if until > next_executor_s:
                next_executor_s = until + EXECUTOR_PERIOD_S
                executor.spin_once(timeout_sec=0.0)
            time.sleep(max(0.0, until - time.monotonic()))

    def _run_cycle(self) -> None:
        """Publish the poses that are due."""
        now_ns = time.monotonic_ns()
        if now_ns - self._searched_ns > SEARCH_PERIOD_S * 1e9:
            self._searched_ns = now_ns
            self._search_publishers(now_ns)
        if now_ns < self._due_ns:
            return
        try:
            poses = self._due_poses(now_ns)
        except Exception as error:      # no message may stop the node
            poses = []
            self._odometry.restart(f'internal error, please report it: {type(error).__name__}: '
                                   f'{error_text(error)}')
        for pose in poses:
            self._publish(pose)
        if poses:
            wait_s = min(self._odometry.wait_s(), 1 / self.config.publish.rate)
            self._due_ns = now_ns + round(wait_s * 1e9)
            if not self._has_published:
                self._has_published = True
                self.get_logger().info('odometry starts')
        for text in self._odometry.take_notes():
            self._log_text(text, now_ns)

    def _due_poses(self, now_ns: int) -> list[Pose]:
        """Return the poses that are due; IMU messages wait for those of the odometer."""
        for slot, source in self._inputs.items():
            if slot != 'imu':
                self._feed(source)
        is_recent = now_ns - self._reckoned_ns < RECKONING_PERIOD_S * 1e9
        if self._odometry.missing_odometer_s() > 0 and is_recent:
            return []
        self._reckoned_ns = now_ns
        self._feed(self._inputs['imu'])
        return self._odometry.poses()

    def _log_text(self, text: str, now_ns: int) -> None:
        """Log a note of the dead reckoning: every restart, other kinds at a limited rate."""
        kind = re.sub(r'[-+.\de]*\d', '#', text)
        if text.startswith(RESTARTS) or now_ns - self._logged_ns.get(kind, 0) > LOG_INTERVAL_NS:
            self._logged_ns[kind] = now_ns
            self.get_logger().warning(text)

    def _feed(self, source: Input) -> None:
        """Feed the new messages of an input to the dead reckoning."""
        raws, sent_ns = source.take()
        for slot, rows in source.readings(raws, sent_ns) if raws else ():
            if slot != 'imu_other':
                self._odometry.feed(slot, rows, source.reader.form if source.reader else None)
        if source.health.has_jumped_back:
            source.health.reset_times()

    def _search_publishers(self, now_ns: int) -> None:
        """Search for publishers, and log missing inputs at a low rate."""
        inputs = self._inputs.values()
        for source in inputs:
            source.search_publishers(self.config)
        for text in self._topics.new_texts(
                {source.topic: source.health.lost_count for source in inputs},
                [source.duplicate_publishers() for source in inputs]):
            self.get_logger().warning(text)
        missing = list(filter(None, (source.missing_reason() for source in inputs)))
        clock_difference_s = self._odometry.clock_difference_s()
        if not missing and clock_difference_s:
            missing = [stamp_difference_text(clock_difference_s)]
        if not missing:
            self._log_due_ns, self._pause_ns = 0, MISSING_LOG_DELAY_NS
        elif not self._log_due_ns:
            self._log_due_ns = now_ns + self._pause_ns
        elif now_ns > self._log_due_ns:
            self.get_logger().warning('nothing is published: ' + '; '.join(missing))
            self._pause_ns = MAX_MISSING_LOG_INTERVAL_NS
            self._log_due_ns = now_ns + self._pause_ns

    def _publish(self, pose: Pose) -> None:
        self._twist.send(pose.stamp_ns, pose.raw[TWIST_OFFSET:])
        self._pose.send(pose.stamp_ns, pose.raw)
        if self._send_transform is not None:
            self._send_transform(transform_of(pose, self.config.frames))

    def _transform_sender(self) -> Callable[[TransformStamped], None]:
        try:
            kind = message_class('tf2_msgs/msg/TFMessage')
        except BadConfig:
            raise BadConfig('publish_tf needs the package tf2_msgs, which is not installed: '
                            'install ros-jazzy-tf2-msgs, or set publish_tf to false') from None
        publisher = self.create_publisher(kind, '/tf', 100)
        return lambda transform: publisher.publish(kind(transforms=[transform]))


def transform_of(pose: Pose, frames: OdomFrames) -> TransformStamped:
    """Return a pose as the transform from the frame odom to the frame base."""
    out = TransformStamped(child_frame_id=frames.base, header=Header(frame_id=frames.odom))
    out.header.stamp.sec, out.header.stamp.nanosec = divmod(pose.stamp_ns, 10**9)
    position, q = out.transform.translation, out.transform.rotation
    position.x, position.y, position.z = pose.position.tolist()
    q.x, q.y, q.z, q.w = pose.q.tolist()
    return out


main = partial(run, OdometryNode, HELP)
