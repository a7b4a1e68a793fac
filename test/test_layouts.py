# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The layouts for RViz, Foxglove and PlotJuggler: complete, with names of those programs."""

import re

import layout_names
import pytest

from odocal_ros.settings.config import SETTINGS

# from rviz_default_plugins/plugins_description.xml of Jazzy, those of interest here
RVIZ = {'rviz_common/Displays', 'rviz_common/Views', 'rviz_common/Selection', 'rviz_common/Time',
        *(f'rviz_default_plugins/{name}' for name in (
            'Axes', 'Grid', 'Path', 'TF', 'MoveCamera', 'Measure', 'FocusCamera', 'Select',
            'Interact', 'TopDownOrtho', 'Orbit', 'XYOrbit'))}
# panel types of Foxglove's catalogue
PANELS = {'3D', 'map', 'DiagnosticStatusPanel', 'DiagnosticSummary', 'StateTransitions', 'Plot',
          'Parameters', 'RosOut', 'CallService', 'Tab'}
OUTPUTS = {'/calibrator/status', '/diagnostics', '/calibrator/path/dead_reckoning',
           '/calibrator/path/reference'}
INPUTS = {'/imu/data', '/odometer', '/fix'}


def all_values(tree, key):
    if isinstance(tree, dict):
        return [v for k, v in tree.items() if k == key] + [
            v for sub in tree.values() for v in all_values(sub, key)]
    return [v for sub in tree for v in all_values(sub, key)] if isinstance(tree, list) else []


def leaves(layout):
    """Return the panels that a split of Foxglove names."""
    if isinstance(layout, str):
        return [layout]
    assert layout['direction'] in ('row', 'column')
    assert 0 < layout['splitPercentage'] < 100
    return leaves(layout['first']) + leaves(layout['second'])


def test_rviz_shows_both_paths_latched_by_its_own_classes():
    classes = [c for c in all_values(layout_names.rviz(), 'Class') if c]
    assert len(classes) > 8
    assert set(classes) <= RVIZ
    options = layout_names.rviz()['Visualization Manager']['Global Options']
    assert options['Fixed Frame'] == SETTINGS['frames.local'].default
    paths = [d for d in layout_names.rviz_displays() if d['Class'].endswith('/Path')]
    assert {d['Topic']['Value'] for d in paths} == {
        f'calibrator/path/{name}' for name in ('dead_reckoning', 'reference')}
    for display in paths:
        # a volatile subscription misses what was published before RViz came
        assert display['Topic']['Durability Policy'] == 'Transient Local'
        assert display['Topic']['Reliability Policy'] == 'Reliable'
        assert display['Enabled']
        assert display['Value']
    assert len({d['Color'] for d in paths}) == 2


@pytest.mark.parametrize(('name', 'panels'), [
    ('odocal_foxglove.json', PANELS), ('odocal_result_foxglove.json', {'map', 'Plot'})])
def test_foxglove_has_every_panel_once_with_a_known_type(name, panels):
    layout = layout_names.foxglove(name)
    placed = leaves(layout['layout'])
    for panel in layout['configById'].values():
        for tab in panel.get('tabs', ()):
            placed += leaves(tab['layout'])
    assert sorted(placed) == sorted(layout['configById'])
    assert {name.partition('!')[0] for name in placed} == panels


def test_foxglove_shows_paths_status_and_curves():
    panels = layout_names.foxglove()['configById']
    assert panels['3D!paths']['followTf'] == SETTINGS['frames.local'].default
    assert all(topic['type'] == 'line' for topic in panels['3D!paths']['topics'].values())
    paths = layout_names.foxglove_paths()
    assert len(paths) == len(set(paths)) > 12
    for path in paths:
        assert layout_names.KEY.search(path) or re.fullmatch(r'/[a-z/]+(\.[a-z_]+)+', path), path


def test_plotjuggler_is_complete_and_subscribes_to_its_curves():
    root = layout_names.plotjuggler()
    assert root.tag == 'root'
    for splitter in root.iter('DockSplitter'):
        assert int(splitter.get('count')) == len(splitter) == len(splitter.get('sizes').split(';'))
    assert len(list(root.iter('Tab'))) == 3
    wanted = {t for t in ('/calibrator/status', '/imu/data', '/odometer')
              if any(name.startswith(t + '/') for name in layout_names.curves())}
    for plugin in root.iter('plugin'):
        assert set(plugin.find('selected_topics').get('value').split(';')) == wanted


def test_all_topics_in_the_layouts_are_of_the_node():
    assert set(layout_names.published()) == OUTPUTS
    assert {topic for topic, _ in layout_names.of_inputs()} <= INPUTS
    assert layout_names.status_names() == {('odocal', 'calibrator: calibration')}
    assert {s.rpartition('/')[0] for s in layout_names.services()} == {'/calibrator'}
