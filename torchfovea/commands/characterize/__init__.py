"""`torchfovea characterize`: the sensor's precision."""
