"""Pictures of meshes; knows neither torch nor recipes."""
