"""A page in the browser on which meshes and made-up bodies are posed like each other."""
