# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a leg cannot use if its positions are in a local frame, whose y axis is not north."""

from dataclasses import replace
import math

import numpy as np

from odocal_ros.data.leg import Leg
from odocal_ros.data.samples import FixSamples, HeadingSamples, LOCAL, VelocitySamples
from odocal_ros.nav.earth import OMEGA
from odocal_ros.nav.local_frame import LARGEST_FRAME
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config


def settings_by_frame(fix: FixSamples, config: Config) -> Config:
    """Return the settings that apply to positions, by their frame."""
    return config.in_local_frame() if is_local(fix) else config


def is_local(fix: FixSamples) -> bool:
    """Return True if positions are in a local frame."""
    return bool((fix.status == LOCAL).any())


def without_north(leg: Leg, config: Config) -> tuple[Leg, tuple[Reason, ...]]:
    """
    Return a leg and LOCAL_FRAME if its positions are in a local frame, otherwise nothing.

    The leg is without GNSS velocities, which are east and north, and without a heading topic
    unless the settings ask for it: that is a heading in the local frame then.
    """
    if not is_local(leg.fix):
        return leg, ()
    left_out = ['GNSS velocities'] * bool(len(leg.fix_velocity.stamp_ns))
    leg = replace(leg, fix_velocity=VelocitySamples.none())
    if config.alignment.heading_source == 'auto' and len(leg.heading.stamp_ns):
        left_out += ['external headings']
        leg = replace(leg, heading=HeadingSamples.none())
    latitude = math.radians(config.reference.latitude_deg)
    unknown = OMEGA if math.isnan(latitude) else OMEGA * math.cos(latitude)
    text = ('positions are in a local frame, so north is unknown: up to '
            f'{math.degrees(unknown) * 3600:.1f} deg/h of the Earth rate are estimated as gyro '
            'bias')
    if left_out:
        text += f'; {" and ".join(left_out)} are not used'
    found = Reason(Code.LOCAL_FRAME, text)
    if not np.isnan(leg.fix.latitude).all():
        return leg, (found,)
    return leg, (found, Reason(
        Code.FIXES_UNUSABLE, f'all {len(leg.fix.latitude)} positions are NaN or more than '
        f'{LARGEST_FRAME / 1000:g} km from the origin of their frame, as map coordinates are',
        'Publish positions in a frame with its origin near the site.'))
