"""The commands of `amvnet`, one file each."""
