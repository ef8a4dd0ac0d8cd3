"""Evaluation: episodes played by the protocol, statistics over their rows, reports and calibration."""
