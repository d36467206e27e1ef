"""The numbers of a model and of a training: schema, bounds and recipes."""
