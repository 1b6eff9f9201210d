"""The commands: each takes a composed Hydra configuration and leaves a folder of figures, tables and pictures."""
