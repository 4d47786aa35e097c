"""A graph network that corrects a coarse solver's steps, and the hybrid that they make."""
