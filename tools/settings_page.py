# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Pages made from the settings and reasons: config/calibrator.yaml and its like, docs/*.md.

``python -m tools.settings_page`` compares them with the code, ``--write`` makes
them agree. A test says so too.
"""

import argparse
from pathlib import Path
import sys
import textwrap

from odocal_ros.settings.config import Config, SETTINGS, settings_of
from odocal_ros.settings.node_configs import ApplyConfig, PatternConfig
from odocal_ros.settings.setting import Setting
from tools.reasons_page import reasons_md

ROOT = Path(__file__).resolve().parent.parent
YAML_HEAD = """\
# Every setting of {} with its default, made by: python -m tools.settings_page --write
# {}
/**/{}:
  ros__parameters:
"""
SETTINGS_HEAD = """\
# Settings

Made from `odocal_ros/settings/config.py` by `python -m tools.settings_page --write`.

The node's parameters, the keys of `--config` files, of `--set` and of `config=` in Python;
`(read-only)`: fixed at start-up, the others change between legs. `config/calibrator.yaml` holds
them all with their defaults."""
NODES = {
    'calibrator': (Config, YAML_HEAD.format('odocal_ros', 'The node takes it by --params-file, '
                                            'odocal replay by --config. Keep the lines you '
                                            'change.', 'calibrator')),
    'odometry': (ApplyConfig, YAML_HEAD.format('the node odometry', 'It takes it by '
                                               '--params-file, beside the calibration.yaml. Keep '
                                               'the lines you change.', 'odometry')),
    'drive_pattern': (PatternConfig, YAML_HEAD.format(
        'the node drive_pattern', 'It takes it by --params-file. Keep the lines you change.',
        'drive_pattern'))}
TYPES = {'bool': 'bool', 'int': 'int', 'float': 'double', 'str': 'string', 'floats': 'double[]',
         'strs': 'string[]'}


def scalar_text(value) -> str:
    """Return a value as YAML with the same type for rcl and YAML 1.1 readers."""
    if isinstance(value, (tuple, list)):
        return f'[{", ".join(scalar_text(v) for v in value)}]'
    import yaml
    return yaml.safe_dump(value, width=2000).removesuffix('...\n').strip()


def limits(setting: Setting) -> str:
    """Return a setting's unit and what values it takes, for people."""
    parts = [setting.unit] if setting.unit not in ('', '1') else []
    if setting.choices:
        parts.append(('any of ' if setting.kind == 'strs' else 'one of ')
                     + ', '.join(setting.choices))
    if setting.low is not None and setting.high is not None:
        high = '2^62' if setting.high == 2**62 else f'{setting.high:g}'
        parts.append(f'{setting.low:g} to {high}')
    return ', '.join(parts)


def config_yaml(node: str) -> str:
    """Return the text of config/<node>.yaml."""
    kind, head = NODES[node]
    lines, group = [], ''
    for name, setting in settings_of(kind).items():
        here, _, leaf = name.rpartition('.')
        if here != group:
            lines += ['', f'    {here}:']
            group = here
        indent = '      ' if here else '    '
        about = setting.about + (' Fixed at start-up.' if setting.read_only else '')
        notes = [about, f'[{limits(setting)}]'] if limits(setting) else [about]
        for note in notes:
            lines += textwrap.wrap(note, 97, initial_indent=f'{indent}# ',
                                   subsequent_indent=f'{indent}# ', break_on_hyphens=False)
        lines.append(f'{indent}{leaf}: {scalar_text(setting.default)}')
    return head + '\n'.join(lines) + '\n'


def settings_md() -> str:
    """Return the text of docs/settings.md."""
    rows = [SETTINGS_HEAD]
    group = None
    for name, setting in SETTINGS.items():
        here = name.rpartition('.')[0]
        if here != group:
            rows += ['', f'## {here or "general"}', '',
                     '| parameter | type | default | unit, values | meaning |',
                     '|---|---|---|---|---|']
            group = here
        fixed = ' (read-only)' if setting.read_only else ''
        default = scalar_text(setting.default).replace("''", "`''`")
        rows.append(f'| `{name}` | {TYPES[setting.kind]}{fixed} | {default} | {limits(setting)} | '
                    f'{setting.about} |')
    return '\n'.join(rows) + '\n'


def pages(root: Path = ROOT) -> dict[Path, str]:
    """Return each page's path and the text it should have."""
    return {**{root / 'config' / f'{node}.yaml': config_yaml(node) for node in NODES},
            root / 'docs' / 'settings.md': settings_md(),
            root / 'docs' / 'reasons.md': reasons_md()}


def main() -> int:
    """Print the stale pages (exit 1), or write them."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--write', action='store_true', help='write the pages that are stale')
    write = parser.parse_args().write
    stale = [(path, text) for path, text in pages().items()
             if not path.exists() or path.read_text(encoding='utf-8') != text]
    for path, text in stale:
        if write:
            path.write_text(text, encoding='utf-8')
        print(f'{"written" if write else "stale"}: {path}')
    return 1 if stale and not write else 0


if __name__ == '__main__':
    sys.exit(main())
