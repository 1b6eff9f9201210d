"""`torchfovea benchmark`: policies, matchers, memories and whole systems under one frozen protocol."""
