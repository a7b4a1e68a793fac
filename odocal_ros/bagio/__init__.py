"""Bags read and written, whole or damaged: the only place of rosbags."""
