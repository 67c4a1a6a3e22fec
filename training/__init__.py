"""Learning pose transfer: networks, losses, trainer, evaluation, transfer. Reads datasets, never makes them."""
