"""Calibration, tuning, and what they are made of."""
