# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Planar estimator: wheel constants of a robot on a level floor from wheels and positions.

``run`` has the kinematics, input and result, ``first_values`` the cold start, ``chain`` the linear
equations, ``fit`` the fit, ``result`` the estimates. Poses are of base_link in the frame of the
positions: x, y in m, heading in rad.
"""
