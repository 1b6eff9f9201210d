"""`torchfovea calibrate`: is the claimed uncertainty true."""
