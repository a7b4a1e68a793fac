"""From bytes to samples: CDR, message types, what of a message is the counter."""
