"""Angles: wrapping, and heading (from north, clockwise) against yaw (from east, ccw)."""

import numpy as np


def wrap(angle):
    """Bring an angle into (-pi, pi]."""
    return -((np.pi - np.asarray(angle)) % (2 * np.pi) - np.pi)


def yaw_from_heading(heading):
    """Turn compass heading into ENU yaw, rad."""
    return wrap(np.pi / 2 - heading)


def heading_from_yaw(yaw):
    """Turn ENU yaw into compass heading, rad, in [0, 2 pi)."""
    return (np.pi / 2 - yaw) % (2 * np.pi)
