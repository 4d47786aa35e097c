"""Training of correctors, one-step and with the simulator in the loop."""
