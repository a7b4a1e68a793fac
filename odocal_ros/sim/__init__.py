"""Drives with known truth: roads, vehicles, sensors and their errors."""
