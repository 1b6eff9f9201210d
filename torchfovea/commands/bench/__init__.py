"""Hot paths beside the peers that a user would pick, timed in one run."""
