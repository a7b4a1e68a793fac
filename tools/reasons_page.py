# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
``docs/reasons.md``: what each reason code means and what to do about it, made from the enum.

Severity and remedy are in ``reasons.py``, the explanation of each code in
``tools/reason_meanings.py``. ``python -m tools.settings_page --write`` writes this page with the
others.
"""

import textwrap

from odocal_ros.reasons import Verdict
from tools.reason_meanings import MEANINGS

HEAD = """\
# Reasons

Made from `odocal_ros/reasons.py` by `python -m tools.settings_page --write`.

A result, a leg and the live status list their findings. Each has a code, a text with numbers and
limits, and a remedy. There are three severities:

* **rejects**: the values must not be used; they are shown and stored only for diagnosis;
* **caution**: read the text, then use the values or drive again;
* **note**: for information; the verdict does not change.

*odocal inspect* finds many of these before a calibration. Times in the texts are seconds since the
start mark.
"""
WEIGHTS = {Verdict.REJECTED: 'rejects', Verdict.CAUTION: 'caution', Verdict.ACCEPTED: 'note'}


def reasons_md() -> str:
    """Return the text of docs/reasons.md."""
    lines = [HEAD]
    for section, codes in MEANINGS.items():
        lines.append(f'## {section}\n')
        for code, meaning in codes.items():
            lines += [f'### {code.name}\n',
                      *_wrapped(f'*{WEIGHTS[code.severity]}.* {meaning}'), '',
                      *_wrapped(f'**Do:** {code.remedy}'), '']
    return '\n'.join(lines).rstrip() + '\n'


def _wrapped(text: str) -> list[str]:
    return textwrap.wrap(text, 99, break_on_hyphens=False, break_long_words=False)
