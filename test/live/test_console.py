# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the node says on its console: what it waits for, readiness, silence, faults."""

import time
from types import SimpleNamespace

from bench import wait_for

from odocal_ros.live.console import Console
from odocal_ros.live.inputs import LOOK_AROUND_S
from odocal_ros.live.session import Session, SessionView
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config

SECOND = 10**9


def test_each_thing_is_said_once_or_seldom():
    said = []
    console = Console(SimpleNamespace(info=lambda x: said.append(('info', x)),
                                      warning=lambda x: said.append(('warning', x))))
    session = Session()

    def report(second, **known):
        before = len(said)
        console.report(SessionView(session, Config(), **known), second * SECOND)
        return said[before:]

    nothing = {'missing': ['no IMU on /imu/data']}
    times = [s for s in range(-20000, 280) if report(s, **nothing)]
    assert [t + 20000 for t in times[:4]] == [5, 15, 35, 75]       # 5 s, then ever more seldom
    assert max(b - a for a, b in zip(times, times[1:], strict=False)) == 3600
    # what is missing changes: soon again; the seconds of a silence are no change
    other = {'missing': ['no IMU on /imu/data for 3 s: 1 publisher found']}
    assert [s for s in range(280, 290) if report(s, **other)] == [285]
    assert report(290, missing=['no IMU on /imu/data for 9 s: 1 publisher found']) == []
    assert report(300, rates_hz={'imu': 100.0})[0] == (
        'info', 'ready (imu 100 Hz): stand still for 10 s, then call ~/start_leg')
    assert report(301) == []
    assert report(302, **nothing) == [('warning', 'no IMU on /imu/data')]       # at once now
    assert report(303, **nothing) == []
    assert report(304) == [('info', 'all inputs are available again')]
    two = {'doubled': ['/ticks has 2 publishers (/a, /b)']}
    assert report(305, **two) == [('warning', two['doubled'][0])]
    assert report(306, **two) == []
    for lost, new in ((0, False), (3, True), (29, False), (31, True), (32, False), (0, False),
                      (1, True)):       # of the next leg
        line = report(306, lost_messages={'/ticks': lost, '/imu': 0})
        assert bool(line) == new, lost
        assert all(f'{lost} message{"s" * (lost > 1)} of /ticks lost. Likely' in text
                   for _, text in line)
    gap = {'faults': (Reason(Code.IMU_GAP, 'no IMU data for 3 s'),)}
    for _ in range(2):                                   # of each leg
        session.start(1, Config())
        (level, text), = report(307, **gap)
        assert text.startswith(f'leg {session.leg_id}: IMU_GAP: no IMU data for 3 s. Fix')
        assert report(308, **gap) == []
        session.cancel()


def test_a_problem_that_later_messages_contradict_is_withdrawn_once():
    """An IMU whose messages are late looks silent; then all of them arrive."""
    said, session = [], Session()
    console = Console(SimpleNamespace(info=said.append, warning=said.append))
    cut = (Reason(Code.LEG_CUT, 'the IMU is missing for 1.30 s'),)
    session.start(1, Config())
    for second, faults in enumerate([cut, (), (), cut, ()]):
        console.report(SessionView(session, Config(), faults=faults), second * SECOND)
    assert [x for x in said if 'LEG_CUT' in x and 'no longer' not in x] == [said[0]]
    assert [x for x in said if 'no longer' in x] == [
        'leg 1: LEG_CUT no longer applies: later messages contradict it']
    # the end of a leg withdraws nothing
    session.cancel()
    session.start(2, Config())
    console.report(SessionView(session, Config(), faults=cut), 9 * SECOND)
    session.cancel()
    console.report(SessionView(session, Config()), 10 * SECOND)
    assert sum('no longer' in x for x in said) == 1


def test_ready_without_known_rates_has_no_empty_brackets():
    said = []
    Console(SimpleNamespace(info=said.append)).report(SessionView(Session(), Config()), SECOND)
    assert said == ['ready: stand still for 10 s, then call ~/start_leg']


def test_topics_that_may_be_meant_and_doubled_publishers_are_named(start, connect):
    from sensor_msgs.msg import Imu
    from std_msgs.msg import Int64
    node, client = start(), connect()
    client.node.create_publisher(Imu, '/my_imu', 10)
    for _ in range(2):
        client.node.create_publisher(Int64, '/odometer', 10)
    line = wait_for(lambda: next((x for x in node.lines if 'waiting: ' in x), ''), 'a word')
    assert 'no IMU on /imu/data: 0 publishers found' in line
    assert '(did you mean /my_imu?)' in line
    named = f'/odometer has 2 publishers (/{client.node.get_name()}'
    wait_for(lambda: any(named in x for x in node.lines), 'who publishes')
    assert 'UNKNOWN' not in node.text
    assert client.call('start_leg').success is False
    wait_for(lambda: '~/start_leg refused: no leg can be started' in node.text, 'the refusal')


def test_a_sender_that_returns_with_another_type_is_named(start, connect):
    from geometry_msgs.msg import TwistStamped
    from std_msgs.msg import Int64
    node, client, other = start(), connect(), connect()
    speed = client.node.create_publisher(TwistStamped, '/odometer', 10)
    wait_for(speed.get_subscription_count, 'the subscription')
    sent = TwistStamped()
    sent.header.stamp.sec = 1
    speed.publish(sent)
    other.node.create_publisher(Int64, '/odometer', 10)
    wait_for(lambda: client.node.count_publishers('/odometer') == 2, 'the second publisher')
    time.sleep(2 * LOOK_AROUND_S)
    assert 'their messages are mixed' not in node.text
    client.node.destroy_publisher(speed)
    wait_for(lambda: any('/odometer is published as std_msgs/msg/Int64; required: '
                         'geometry_msgs/msg/TwistStamped. Remap odometer, or restart the node'
                         in line for line in node.lines), 'the two types')
