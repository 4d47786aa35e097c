"""Many scenes at once, in torch, on the CPU or a GPU."""
