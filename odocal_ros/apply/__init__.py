# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Odometry with a calibration: pose and twist with covariance from counter and IMU."""
