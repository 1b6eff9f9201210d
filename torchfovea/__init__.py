"""Active foveal stereo: where to look next, and how well each glance is known."""

__version__ = "0.1.0"
