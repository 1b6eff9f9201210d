"""`torchfovea memory`: the memory's studies."""
