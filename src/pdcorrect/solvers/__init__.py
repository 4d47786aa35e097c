"""Time stepping: projective dynamics, Newton, and rollouts of any stepper."""
