# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Table of the inputs: names, topics, queues, clocks and required columns."""

from typing import NamedTuple

# slots of the wheels, in the order of odometer.wheels. Judgement: at most 8, as in an 8x8 truck
WHEELS = ('odometer', 'odometer_right', *(f'odometer_{k}' for k in range(3, 9)))


class Input(NamedTuple):
    """
    One input; its slot is its name in code, bags, journals and options.

    label : name in texts.   sample_class : name of its class in ``data/samples.py``.
    required_columns : columns without NaN and impossible values in a usable row.   clock : group
    of settings with its ``time_offset``, or empty.   topic : default topic of the node; empty for
    further wheels of one message.   queue : depth of the subscription, messages.   value_limits :
    of a scalar sensor, None: no limits.
    """

    label: str
    sample_class: str      # not the class itself: settings use this module without numpy
    required_columns: tuple[str, ...]
    clock: str = ''
    topic: str = ''
    queue: int = 0
    value_limits: tuple[float, float] | None = None


# queues, physical: messages of five seconds at the highest expected rates, 4 kHz, 1 kHz and 100 Hz
INPUTS = {
    'imu': Input('IMU', 'ImuSamples', ('w_i', 'f_i'), 'imu', 'imu/data', 20_000),
    'odometer': Input('odometer', 'OdometerSamples', ('value',), 'odometer', 'odometer', 5000),
    'odometer_right': Input('right odometer', 'OdometerSamples', ('value',), 'odometer',
                            'odometer_right', 5000),
    **{slot: Input(slot.replace('_', ' '), 'OdometerSamples', ('value',), 'odometer')
       for slot in WHEELS[2:]},
    'fix': Input('fix', 'FixSamples', ('latitude', 'longitude'), 'gnss', 'fix', 500),
    'heading': Input('heading', 'HeadingSamples', ('q_ni',), '', 'heading', 5000),
    'fix_velocity': Input('GNSS velocity', 'VelocitySamples', ('velocity_n',), 'gnss',
                          'fix_velocity', 500),
    # physical: Pa, from 16 km above the ground to 6 km below; a value in hPa is not possible
    'pressure': Input('air pressure', 'ScalarSamples', ('value',), '', 'pressure', 1000,
                      (1e4, 2e5)),
}
# sensors other than IMU, odometer and fixes
EXTERNAL_SLOTS = tuple(slot for slot in INPUTS if slot not in ('imu', *WHEELS, 'fix'))
TOPICS = {slot: source.topic for slot, source in INPUTS.items() if source.topic}


def topic_option(slot: str) -> str:
    """Return the option of the commands that names the topic of an input."""
    return f'--{slot.replace("_", "-")}-topic'
