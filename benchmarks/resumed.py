"""Rows of a benchmark that goes on where it was interrupted: one JSON object a line."""

import json


def read_rows(path) -> dict[int, dict]:
    """Return rows by seed; a last line cut short by an interruption is done again."""
    rows = {}
    if path.exists():
        text = path.read_text()
        if text and not text.endswith('\n'):
            text = text[:text.rfind('\n') + 1]
            path.write_text(text)
        rows = {row['seed']: row for row in map(json.loads, text.splitlines())}
    return rows
