"""Matching the two eyes' pictures."""
