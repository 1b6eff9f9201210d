"""`torchfovea replay`: a recording into the memory, frame by frame."""
