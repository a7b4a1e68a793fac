# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A calibration at work: counter and IMU in, pose and twist with their covariance out."""
