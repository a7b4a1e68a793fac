# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Topics, keys and services in the layouts of RViz, Foxglove and PlotJuggler."""

import json
from pathlib import Path
import re
from xml.etree import ElementTree

import yaml

CONFIG = Path(__file__).resolve().parent.parent / 'config'
STATUS = '/calibrator/status'
KEY = re.compile(r'\.status\[0\]\.values\[:\]\{key=="(\w+)"\}\.value$')


def rviz() -> dict:
    return yaml.safe_load((CONFIG / 'odocal.rviz').read_text(encoding='utf-8'))


def rviz_displays() -> list[dict]:
    return rviz()['Visualization Manager']['Displays']


def foxglove(name: str = 'odocal_foxglove.json') -> dict:
    """Return a Foxglove layout, by default that of the node."""
    return json.loads((CONFIG / name).read_text(encoding='utf-8'))


def foxglove_paths() -> list[str]:
    """Return the message paths that Foxglove draws: topic, then fields."""
    return [path['value'] for panel in foxglove()['configById'].values()
            for path in panel.get('paths', ())]


def plotjuggler() -> ElementTree.Element:
    return ElementTree.parse(CONFIG / 'odocal_plotjuggler.xml').getroot()


def curves() -> list[str]:
    """Return the names of PlotJuggler curves: topic, then fields, separated by slashes."""
    return [curve.get('name') for curve in plotjuggler().iter('curve')]


def status_keys() -> set[str]:
    found = {m.group(1) for m in map(KEY.search, foxglove_paths()) if m}
    return found | {name.rpartition('/')[2] for name in curves() if name.startswith(STATUS)}


def status_names() -> set[tuple[str, str]]:
    """Return (hardware_id, name) of the statuses that the layouts select."""
    panels = foxglove()['configById']
    picked = {(p['selectedHardwareId'], p['selectedName']) for p in panels.values()
              if 'selectedName' in p}
    return picked | {tuple(name.removeprefix(f'{STATUS}/').rsplit('/', 1)[0].split('/', 1))
                     for name in curves() if name.startswith(STATUS)}


def published() -> dict[str, str]:
    """Return topic -> type of the node's topics in the layouts."""
    path, array = 'nav_msgs/msg/Path', 'diagnostic_msgs/msg/DiagnosticArray'
    topics = {'/' + d['Topic']['Value']: path for d in rviz_displays() if 'Topic' in d}
    for panel in foxglove()['configById'].values():
        topics |= dict.fromkeys(panel.get('topics', ()), path)
        topic = panel.get('topicToRender')
        if topic and topic != '/rosout':
            topics[topic] = array
    topics |= {m.partition('.')[0]: array for m in foxglove_paths() if KEY.search(m)}
    if any(name.startswith(STATUS) for name in curves()):
        topics[STATUS] = array
    return topics


def of_inputs() -> set[tuple[str, tuple[str, ...]]]:
    """Return (topic, fields) of the node's inputs in the layouts."""
    found = {(m.split('.')[0], tuple(m.split('.')[1:])) for m in foxglove_paths()
             if not KEY.search(m)}
    for name in curves():
        if not name.startswith(STATUS):
            topic = '/imu/data' if name.startswith('/imu/data/') else '/' + name.split('/')[1]
            found.add((topic, tuple(name.removeprefix(topic + '/').split('/'))))
    return found


def services() -> set[str]:
    return {panel['serviceName'] for panel in foxglove()['configById'].values()
            if 'serviceName' in panel}
