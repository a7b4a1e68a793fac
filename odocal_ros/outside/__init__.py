"""The door to the outside: names, YAML and sizes from others, files that others read."""
