"""From two retinas to 3-D points with covariances (Sec. 4)."""
