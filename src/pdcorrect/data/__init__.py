"""Data sets: what they contain, how they are generated, checked, read and exported."""
