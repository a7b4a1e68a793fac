"""From recordings, options and figures to answers: for the commands, and for other programs."""
