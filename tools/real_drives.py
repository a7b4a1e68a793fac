# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Generate the table of docs/recordings.md and the page docs/gallery.md from the real drives.

``python -m tools.real_drives`` prints the table, ``--write`` updates both pages. Drives are the
folders of ``$ODOCAL_DATA`` (else ``../shared/data``) with ``bag`` and ``truth.yaml``; each is
calibrated by ``odocal try``, once for each odometer topic in the truth.
"""

import argparse
from collections.abc import Iterator
import contextlib
import io
import json
import math
import os
from pathlib import Path
import sys
import tempfile
import time
from typing import Any

import yaml

from odocal_ros.offline.cli import main as odocal
from odocal_ros.output.value_text import with_sigma

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / 'docs' / 'recordings.md'
GALLERY = ROOT / 'docs' / 'gallery.md'
BEGIN, END = '<!-- made by tools/real_drives.py -->\n', '<!-- end -->\n'
HEAD = ('| drive | odometer | scale factor, found | reference | off by, sigma | yaw, deg, found | '
        'reference | verdict | s |\n|---|---|---|---|---|---|---|---|---|\n')
GALLERY_HEAD = """# Gallery of real drives

The first answer of `odocal try BAG`, without options, for each public drive of
[recordings.md](recordings.md), which has the references, the sources and the licences. The printed
result continues with check, warnings and files; the report adds budget and curves.
`python -m tools.real_drives --write` generates this page.
"""
DEG = math.degrees(1.0)    # definition


def table(data: Path) -> str:
    """Return the table of all drives in a folder."""
    return HEAD + ''.join(row for folder in sorted(data.iterdir())
                          if (folder / 'truth.yaml').exists() for row in _rows(folder))


def _rows(folder: Path) -> Iterator[str]:
    """Yield a row for each odometer of a drive."""
    truth = yaml.safe_load((folder / 'truth.yaml').read_text(encoding='utf-8'))
    odometer = truth['odometer']
    for kind in ('pulses', 'twist'):
        with tempfile.TemporaryDirectory() as out:
            begin = time.monotonic()
            with contextlib.redirect_stdout(io.StringIO()):
                code = odocal(['try', str(folder / 'bag'), '--odometer-topic', odometer[kind],
                               '--no-browser', '--output', out])
            if code > 1:
                raise SystemExit(f'{folder.name}: odocal try ended with {code}')
            seconds = time.monotonic() - begin
            found = json.loads((Path(out) / 'calibration.json').read_text(encoding='utf-8'))
        unit = odometer['k0_m_per_pulse'] if kind == 'pulses' else 1.0
        yield _row(folder.name, odometer[kind], found, unit, truth, seconds)


def _row(name: str, topic: str, found: dict[str, Any], unit: float, truth: dict[str, Any],
         seconds: float) -> str:
    references = {key.removeprefix('scale').strip('_'): truth[key]
                  for key in truth if key.startswith('scale')}
    scales = {word: _scale(found['result'], word, unit) for word in references}
    off = ['-' if pair is None else _off(*pair, references[word])
           for word, pair in scales.items()]
    stated = list(dict.fromkeys('-' if pair is None else with_sigma(*pair)
                                for pair in scales.values()))
    said = [f'{_stated(r)} {word}'.strip().replace('_', ' ') for word, r in references.items()]
    yaw = found['result']['yaw_mounting_angle']
    angle = '-' if yaw['value'] is None else with_sigma(yaw['value'], yaw['sigma'], DEG)
    return (f'| `{name}` | `{topic}` | {"; ".join(stated)} | '
            f'{"; ".join(said)} | {"; ".join(off)} | {angle} | '
            f'{_stated(truth["yaw_mounting_deg"])} | {found["verdict"]} | {seconds:.0f} |\n')


def _scale(result: dict[str, Any], word: str, unit: float) -> tuple[float, float] | None:
    """Return scale and sigma to compare with a reference: of speeds as sent their own, if any."""
    scale = result['scale_factor']
    if word == 'as_sent':
        scale = result.get('scale_factor_as_sent', scale)
    return None if scale['value'] is None else (scale['value'] / unit, scale['sigma'] / unit)


def _off(value: float, sigma: float, reference: dict[str, float]) -> str:
    return f'{(value - reference["value"]) / math.hypot(sigma, reference["sigma"]):+.1f}'


def _stated(reference: dict[str, float]) -> str:
    return with_sigma(float(reference['value']), float(reference['sigma']))


def gallery(data: Path, pictures: Path) -> str:
    """Return the page of all drives in a folder; write a map of each."""
    from odocal_ros.library.export_pictures import map_figure
    from odocal_ros.output.plot_style import apply_style, save_figure
    page = GALLERY_HEAD
    for folder in sorted(path.parent for path in data.glob('*/truth.yaml')):
        said = io.StringIO()
        with tempfile.TemporaryDirectory() as out, apply_style():
            with contextlib.redirect_stdout(said):
                odocal(['try', str(folder / 'bag'), '--no-browser', '--output', out])
            shapes = json.loads((Path(out) / 'track.geojson').read_text(encoding='utf-8'))
            for shape in shapes['features']:
                shape['geometry']['coordinates'] = _few(shape['geometry']['coordinates'])
            save_figure(map_figure(shapes['features']), pictures / f'{folder.name}.svg')
        text = said.getvalue().partition('\n\n  track against')[0].strip()
        page += (f'\n## {folder.name}\n\n![Track and fixes](pictures/{folder.name}.svg)\n\n'
                 f'```text\n{text}\n```\n')
    return page


def _few(coordinates: list[Any]) -> list[Any]:
    """Return at most 400 of the points of a line, for a small file."""
    return coordinates[::1 + len(coordinates) // 400]


def main() -> None:
    """Print the table, or update both pages."""
    parser = argparse.ArgumentParser(description='real drives against their references')
    parser.add_argument('--write', action='store_true', help='into the pages of docs')
    args = parser.parse_args()
    data = Path(os.environ.get('ODOCAL_DATA') or ROOT.parent / 'shared' / 'data')
    made = table(data)
    if not args.write:
        sys.stdout.write(made)
        return
    before, _, rest = PAGE.read_text(encoding='utf-8').partition(BEGIN)
    PAGE.write_text(before + BEGIN + made + END + rest.partition(END)[2], encoding='utf-8')
    GALLERY.write_text(gallery(data, GALLERY.parent / 'pictures'), encoding='utf-8')


if __name__ == '__main__':
    main()
