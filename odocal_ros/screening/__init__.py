"""From samples to inputs: what is usable, what is damaged, late, mirrored or turned."""
