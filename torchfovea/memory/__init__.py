"""The sensory ego-sphere: cells, association, fusion (Sec. 5)."""
