"""Rewards and where to look next (Sec. 6)."""
