"""Reading recipes by name, file or dataset."""
