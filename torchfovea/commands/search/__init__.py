"""`torchfovea search`: visual searches."""
