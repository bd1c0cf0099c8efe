"""What the client and the simulated server cost, as ratios to a floor that is measured beside them."""
