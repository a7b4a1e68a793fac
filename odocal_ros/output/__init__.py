"""Files, report and words of a result."""
