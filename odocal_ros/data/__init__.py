"""Samples, the legs made of them, and rows that outgrow memory: arrays, and what was sent."""
