"""The GNSS / Imu / odometer smoother: a batch maximum likelihood over all samples of a leg."""

from odocal_ros.calib.smoother.leg import smoother_leg, SmootherLeg
from odocal_ros.calib.smoother.smoother import bound, keyframe_times, smooth

__all__ = ['SmootherLeg', 'bound', 'keyframe_times', 'smooth', 'smoother_leg']
