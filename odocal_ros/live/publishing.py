# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Publishers of the node: status, diagnostics, paths, result parameters."""

from functools import partial
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nav_msgs.msg import Path as PathMessage
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from std_msgs.msg import Float64, String

from odocal_ros.calib.result import Calibration
from odocal_ros.live import params
from odocal_ros.live.answers import action_first
from odocal_ros.live.recording import Recording
from odocal_ros.live.session import SessionView
from odocal_ros.live.status import calibration_status, in_force, input_status
from odocal_ros.live.status_listener import LATCHED
from odocal_ros.live.worker import Paths
from odocal_ros.output.figures import iso
from odocal_ros.safe_io.text_formats import date_text
from odocal_ros.settings.config import Config

PLOTTED = ('scale_factor', 'scale_factor_sigma', 'yaw_mounting_angle', 'yaw_mounting_angle_sigma')
PARTS = {'fix': 'gnss', 'fix_velocity': 'gnss velocity', 'odometer_right': 'odometer right'}


class Publishing:
    """Publishers and result parameters of a node."""

    def __init__(self, node: Node) -> None:
        quiet = PublisherEventCallbacks(use_default_callbacks=False)
        publish = partial(node.create_publisher, event_callbacks=quiet)
        self._node = node
        self._status = publish(DiagnosticArray, '~/status', LATCHED)
        self.status_topic: str = self._status.topic_name      # resolved
        self._diagnostics = publish(DiagnosticArray, '/diagnostics', 1)
        self._hint = publish(String, '~/hint', LATCHED)
        self._plotted = {name: publish(Float64, f'~/{name}', LATCHED) for name in PLOTTED}
        self._shown: dict[Publisher, str] = {}        # last message of each
        self._paths = [publish(PathMessage, f'~/path/{name}', LATCHED)
                       for name in ('dead_reckoning', 'reference')]
        self.setting_results = False      # true while the node itself sets ``result.*``
        self._before = self.results()    # without kept legs: the restored result, or none

    def results(self) -> dict[str, Any]:
        return {name: self._node.get_parameter(name).value for name in params.RESULTS}

    def scale_factor(self) -> float:
        """Return the scale factor in force, NaN without one."""
        return float(self._node.get_parameter('result.scale_factor').value)

    def set_results(self, calibration: Calibration | None) -> None:
        """Set all ``result.*`` at once; None: to the restored result, if there is one."""
        results = self._before
        if calibration:
            stamp = date_text(iso(self._node.get_clock().now().nanoseconds))
            results = params.as_results(calibration, stamp,
                                        self._node.get_parameter('vehicle').value)
        self.setting_results = True
        try:
            self._node.set_parameters_atomically(
                [Parameter(name, value=value) for name, value in results.items()])
        finally:
            self.setting_results = False

    def forget_restored(self) -> None:
        self._before = dict(params.RESULTS)

    def show_paths(self, messages: Paths) -> None:
        for publisher, message in zip(self._paths, messages, strict=True):
            publisher.publish(message)

    def show_status(self, now: SessionView) -> DiagnosticArray:
        array = self._array([calibration_status(now)])
        # the hint first: receivers of the status then have it
        self._show(self._hint, String(data=action_first(now)))
        self._status.publish(array)
        for name, publisher in self._plotted.items():
            self._show(publisher, Float64(data=in_force(now, name)))
        return array

    def _show(self, publisher: Publisher, message: Float64 | String) -> None:
        """Publish a message if it differs from the last one; NaN equals NaN."""
        if repr(message) != self._shown.get(publisher):
            self._shown[publisher] = repr(message)
            publisher.publish(message)

    def show_diagnostics(self, recording: Recording, config: Config) -> None:
        """Publish the health of each input."""
        node = self._node.get_fully_qualified_name()
        if not config.diagnostic_updater.use_fqn:
            node = node.lstrip('/')      # with its namespace, to separate vehicles
        needed = recording.inputs.required(config)
        self._diagnostics.publish(self._array([
            input_status(f'{node}: {PARTS.get(slot, slot)}', one.health, one.why(),
                         one in needed, time.monotonic_ns())
            for slot, one in recording.inputs.by_slot.items()
            if one in needed or slot in recording.inputs.topics]))

    def _array(self, statuses: list[DiagnosticStatus]) -> DiagnosticArray:
        array = DiagnosticArray(status=statuses)
        array.header.stamp = self._node.get_clock().now().to_msg()
        return array
