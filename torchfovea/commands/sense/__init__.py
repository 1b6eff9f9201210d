"""`torchfovea sense`: a pair of images."""
