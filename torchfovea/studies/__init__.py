"""Judging sensors and their uncertainty (Sec. 7.1)."""
