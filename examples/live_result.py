# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Take the result of a running calibrator into another node."""

import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Float64

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Listener(Node):
    """Turns pulses into metres by the newest scale, once it is good to 0.1 %."""

    def __init__(self):
        super().__init__('scale_listener')
        self.newest = {'scale_factor': float('nan'), 'scale_factor_sigma': float('nan')}
        for name in self.newest:
            self.create_subscription(Float64, f'/calibrator/{name}',
                                     lambda message, name=name: self.take(name, message.data),
                                     LATCHED)

    def take(self, name, value):
        self.newest[name] = value      # NaN where nothing is known yet
        scale, sigma = self.newest.values()
        if sigma < 1e-3 * scale:
            print(f'scale factor {scale:.7g} +- {sigma:.2g}', flush=True)


rclpy.init()
rclpy.spin(Listener())
