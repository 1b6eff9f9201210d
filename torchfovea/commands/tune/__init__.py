"""`torchfovea tune`: gradient tuning."""
