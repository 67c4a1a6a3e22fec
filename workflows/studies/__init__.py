"""Studies: of trained weights (robustness, generalisation), and those that train many (sweep, comparison)."""
