"""Driving: TORCS's sensors, car and kind of circuits as pure functions."""
