# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Create an animated picture of ``odocal watch`` from a running node.

``python -m tools.watch_svg --out docs/pictures/watch.svg``: start it before the leg; it ends with
the result. Browsers and code hosts play the file without a script.
"""

import argparse
import io
from pathlib import Path
import time
from typing import Any

from rich.console import Console

from odocal_ros.live.watch import panel, StatusListener

FRAME_S = 1.5       # judgement: s per frame
COLUMNS = 88        # judgement: width of the panel
# for export_svg of rich: terminal lines, without its window and its fonts from a server
FORMAT = """<style>.{unique_id}-matrix {{ font: {char_height}px monospace;
line-height: {line_height}px; }}
{styles}</style>
<defs>{lines}</defs>
<g transform="translate(8, 8)">{backgrounds}<g class="{unique_id}-matrix">{matrix}</g></g>"""
HEAD = """<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" role="img"
aria-label="odocal watch during a drive">
<style>.frame {{ visibility: hidden; animation: shown {cycle}s steps(1) infinite; }}
@keyframes shown {{ 0% {{ visibility: visible; }} {share:.4f}% {{ visibility: hidden; }} }}</style>
<rect width="100%" height="100%" rx="8" fill="#0c0c0c"/>
"""


def animated(frames: list[Any]) -> str:
    """Return an SVG that shows renderables of rich in sequence, in a loop."""
    inside, most = [], 0
    for number, frame in enumerate(frames):
        console = Console(record=True, width=COLUMNS, file=io.StringIO())
        console.print(frame)
        most = max(most, len(console.export_text(clear=False).splitlines()))
        svg = console.export_svg(code_format=FORMAT, unique_id=f'f{number}')
        inside.append(f'<g class="frame" style="animation-delay: {number * FRAME_S}s">'
                      f'{svg}</g>\n')
    height, line, column = 20, 24.4, 0.61      # of rich; column: width over height
    head = HEAD.format(width=COLUMNS * height * column + 16, height=most * line + 16,
                       cycle=FRAME_S * len(frames), share=100 / len(frames))
    return head + ''.join(inside) + '</svg>\n'


def watched(node: str, period: float) -> list[Any]:
    """Return panels of a node from the start of a leg to its result, every ``period`` s."""
    frames: list[Any] = []
    last, state = 0.0, ''
    with StatusListener(node) as listener:
        for level, status, hint in listener:
            shown, now = panel(level, node, status, hint), time.monotonic()
            if status['state'] == state and state in ('calibrated', 'rejected'):
                # the hint is a separate topic: the result has the hint of the second status
                return [*frames[:-1], *[shown] * 4]
            if (status['state'] != state or now - last >= period) and (
                    frames or status['state'] == 'recording'):
                last, state = now, status['state']
                frames.append(shown)
    return frames


def main() -> None:
    """Record the panels and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--out', type=Path, required=True)
    parser.add_argument('--node', default='/calibrator')
    parser.add_argument('--period', type=float, default=30.0, help='s between frames')
    args = parser.parse_args()
    args.out.write_text(animated(watched(args.node, args.period)), encoding='utf-8')


if __name__ == '__main__':
    main()
