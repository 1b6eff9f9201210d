"""`torchfovea reproduce`: the paper's claims."""
